#!/usr/bin/env python3
"""Checks README.md, those of crates, and docs/: links, anchors, options, paths, targets of make, sizes; and links to docs/ in code.

    scripts/check_docs.py                # says what is wrong, a line each; exit code 1 where something is
    scripts/check_docs.py --self-test    # makes documents with one fault of each kind, and fails where one is not found
"""
import re
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Most lines of README, of a page, of a page of results; most words of all.
LINES = {"README.md": 80, "docs": 120, "docs/results": 70}
WORDS = 30_000
# Folders of the repository: a path in backticks that begins with one is a path of ours.
FOLDERS = ("crates/", "docs/", "examples/", "fuzz/", "pipelines/", "scripts/", "testdata/")
# Options of cargo, Snakemake, splat-transform and OpenGaussian.
FOREIGN = set("path release test ignored nocapture profile config cores resources filter-value locked help version eval".split())


def pages(root):
    return [root / "README.md", *sorted((root / "docs").glob("*.md")), *sorted((root / "docs/results").glob("*.md"))]


def split(text):
    """The prose without code, and the pieces of code: spans in backticks and lines of blocks."""
    prose, code, fenced = [], [], False
    for line in text.split("\n"):
        if line.startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            code.append(re.sub(r"(^|\s)#\s.*", "", line))
        else:
            prose.append(line)
    prose = "\n".join(prose)
    code += [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose)]
    return re.sub(r"`[^`]*`", "``", prose), code


def anchors(page):
    """The anchors of a page's headings, as GitHub makes them."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(), re.M)
    heads = [re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", h).strip().lower() for h in heads]
    return {re.sub(r"[^\w\- ]", "", h).replace(" ", "-") for h in heads}


def options(root):
    """The options of our programs: of clap's structs and builders, and of scripts."""
    known = set(FOREIGN)
    for source in root.glob("crates/**/*.rs"):
        text = source.read_text()
        known.update(re.findall(r"long(?:\(| = )\"([a-z0-9-]+)\"", text))
        # A field below an attribute of clap that says long without a name.
        for attribute, field in re.findall(r"#\[arg\((.*?)\)\]\s*(?:#\[[^\n]*\]\s*)*(?:pub(?:\(\w+\))? )?(\w+):", text, re.S):
            if re.search(r"\blong\b", attribute):
                known.add(field.replace("_", "-"))
    for script in root.glob("scripts/*"):
        if script.is_file() and script.name != Path(__file__).name:
            known.update(re.findall(r"[\"' |(]--([a-z][a-z0-9-]*)[\"' |)=]", script.read_text(errors="replace")))
    return known


def targets(root):
    known = set()
    for file in [root / "Makefile", *root.glob("pipelines/*.mk")]:
        for line in re.findall(r"^([a-z][a-z -]*):", file.read_text(), re.M):
            known.update(line.split())
    return known


def made(code):
    """The targets in a piece of code that calls make."""
    for call in re.findall(r"(?:^\s*|&& )make ([^`]*)", code):
        for word in re.sub(r"(?<!\S)-[a-z]+( \d+)? ", "", call).split():
            if not re.fullmatch(r"[a-z][a-z-]*", word):
                break
            yield word


def check(root, words=WORDS):
    """What is wrong, a line each."""
    found, total = [], 0
    known_options, known_targets = options(root), targets(root)
    for page in [*pages(root), *sorted(root.glob("crates/**/README.md"))]:
        name, text = str(page.relative_to(root)), page.read_text()
        most = LINES.get(name) or LINES.get(str(page.parent.relative_to(root)))
        if most:
            total += len(text.split())
            lines = text.count("\n")
            found += [f"{name}: {lines} lines; {most} at most"] if lines > most else []
        prose, code = split(text)
        for link in re.findall(r"\]\(([^)\s]+)\)", prose):
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            if re.match(r"[a-z]+:", link):
                continue
            if not target.exists():
                found.append(f"{name}: no such file: {link}")
            elif anchor and anchor not in anchors(target):
                found.append(f"{name}: no such heading: {link}")
        for piece in code:
            for option in re.findall(r"(?<![\w-])--([a-z][a-z0-9-]*)", piece):
                if option not in known_options:
                    found.append(f"{name}: no program has this option: --{option}")
            for word in re.findall(r"[^\s\"'=(),;]+", piece):
                is_ours = word.startswith(FOLDERS) and not re.search(r"[<>{}$…]|NAME", word)
                if is_ours and not any(root.glob(word.rstrip("/."))):
                    found.append(f"{name}: no such path: {word}")
            found += [f"{name}: no such target: make {t}" for t in made(piece) if t not in known_targets]
    for source in [root / "Makefile", *root.glob("crates/**/*.rs"), *root.glob("scripts/*"), *root.glob("pipelines/*")]:
        if source.is_file() and source.name != Path(__file__).name:
            for link in re.findall(r"\bdocs/[a-z/-]+\.md", source.read_text(errors="replace")):
                if not (root / link).exists():
                    found.append(f"{source.relative_to(root)}: no such file: {link}")
    if total > words:
        found.append(f"README.md and docs: {total} words; {words} at most")
    return found


def self_test():
    good = {
        "README.md": "# A\n\n`make demo`, `prog --fast`, `scripts/run.py --slow`, [a page](docs/page.md#a-part) of `docs/page.md`\n",
        "docs/page.md": "# Page\n\n## A `part`\n\n    make demo OUT=out  # make it quickly\n\n[back](../README.md)\n",
        "docs/results/table.md": "# Table\n\n[page](../page.md)\n",
        "Makefile": "demo: build ## Show\n",
        "crates/lab/prog/src/options.rs": "#[arg(long, default_value_t = 1)]\npub(crate) fast: u32,\n",
        "crates/lab/prog/README.md": "# prog\n",
        "scripts/run.py": 'p.add_argument("--slow")\n',
    }
    faults = [
        ("README.md", "[x](docs/none.md)\n", "README.md: no such file: docs/none.md"),
        ("docs/page.md", "[x](#none)\n", "docs/page.md: no such heading: #none"),
        ("docs/results/table.md", "[x](../page.md#none)\n", "docs/results/table.md: no such heading: ../page.md#none"),
        ("docs/page.md", "`prog --faster`\n", "docs/page.md: no program has this option: --faster"),
        ("docs/page.md", "    prog --slowly\n", "docs/page.md: no program has this option: --slowly"),
        ("docs/page.md", "`scripts/none.py`\n", "docs/page.md: no such path: scripts/none.py"),
        ("README.md", "`make none`\n", "README.md: no such target: make none"),
        ("README.md", "    make demo none\n", "README.md: no such target: make none"),
        ("README.md", "x\n" * 78, "README.md: 81 lines; 80 at most"),
        ("docs/page.md", "x\n" * 114, "docs/page.md: 121 lines; 120 at most"),
        ("docs/results/table.md", "x\n" * 68, "docs/results/table.md: 71 lines; 70 at most"),
        ("crates/lab/prog/README.md", "[x](../../docs/page.md)\n", "crates/lab/prog/README.md: no such file: ../../docs/page.md"),
        ("scripts/run.py", "# docs/none.md\n", "scripts/run.py: no such file: docs/none.md"),
        ("docs/page.md", "x " * 100, "README.md and docs: 128 words; 100 at most"),
    ]
    for file, more, expected in [("README.md", "", None), *faults]:
        with tempfile.TemporaryDirectory() as folder:
            for name, text in good.items():
                path = Path(folder, name)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text + more if name == file else text)
            found = check(Path(folder).resolve(), 100 if expected and "words" in expected else WORDS)
            if found != ([expected] if expected else []):
                sys.exit(f"{file} with {more[:40]!r}: expected {expected}, found {found}")
    print(f"ok: {len(faults)} faults of documents are found, and none in good ones")


if __name__ == "__main__":
    if sys.argv[1:] == ["--self-test"]:
        self_test()
    elif sys.argv[1:]:
        sys.exit(__doc__)
    else:
        wrong = check(ROOT)
        print("\n".join(wrong), end="\n" if wrong else "")
        sys.exit(bool(wrong))
