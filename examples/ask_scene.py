#!/usr/bin/env python3
"""Asks a scene over HTTP, with Python alone (docs/door.md).

    target/release/explore serve --run-dir out/demo &
    examples/ask_scene.py "green kettle" [http://127.0.0.1:7007]
"""
import json
import sys
from urllib.error import HTTPError
from urllib.request import Request, urlopen


def ask(url, tool, **arguments):
    """A tool's answer. What is wrong with the question ends the program."""
    request = Request(f"{url.rstrip('/')}/tools/{tool}", json.dumps(arguments).encode(), {"Content-Type": "application/json"})
    try:
        with urlopen(request) as answer:
            return json.load(answer)
    except HTTPError as e:
        sys.exit(f"{tool}: {json.load(e)['error']}")


def main(text, url="http://127.0.0.1:7007"):
    answer = ask(url, "find", text=text, most=3)
    if answer["matches"] is False:
        print(f"nothing matches {text}; what comes nearest:")
    for found in answer["found"]:
        print(f"object {found['id']}: cosine {found['cosine']}, at {found['centre']}")
    best = answer["found"][0]["id"]
    print("size", ask(url, "measure", object=best)["size"])
    for relation in ask(url, "relations", object=best)["relations"]:
        print(relation["says"])


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(*sys.argv[1:])
