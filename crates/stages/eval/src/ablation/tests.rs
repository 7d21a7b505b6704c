use super::*;
use crate::score::Scores;

const PLAN: &str = "scene a | -\nscene b | -\nseeds | 0 1\nfootprints gated | --gate 0.7\nfeatures paper | gated | --preset paper\n\
    features ours | gated | --method spectral\nclustering free | --cluster free\ntable t | 0 0.5 | paper.free | A table\n\
    row t | paper | free | 50.79 69.62 2.1 | full\nrow t | ours | free | - | ours\n";

/// A folder with a plan and scores; instance mIoU is 0.1 to 0.4 for the paper's row, and 0.3 more for ours.
fn runs(expect: &str) -> (tempfile::TempDir, Plan) {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("plan"), format!("{PLAN}{expect}")).unwrap();
    for (i, cell) in ["a-0", "a-1", "b-0", "b-1"].iter().enumerate() {
        for p in ["p0", "p0.5"] {
            let folder = dir.path().join(cell).join(p);
            std::fs::create_dir_all(&folder).unwrap();
            for (row, more) in [("paper", 0.0), ("ours", 0.3)] {
                let miou = 0.1 * (i + 1) as f64 + more;
                let scores = Scores { instance_miou: Some(miou), instances_per_thing: Some(2.0), ..Scores::default() };
                let path = folder.join(format!("{row}.free.score.json"));
                std::fs::write(path, serde_json::to_vec(&scores).unwrap()).unwrap();
            }
        }
    }
    let plan = Plan::read(&dir.path().join("plan")).unwrap();
    (dir, plan)
}

fn read(dir: &tempfile::TempDir, plan: &Plan) -> Result<(Vec<Table>, Vec<PathBuf>)> {
    results(&Runs { folder: dir.path(), plan })
}

#[test]
fn rows_have_means_intervals_and_paired_gains() {
    let (dir, plan) = runs("expect t | ours.free | 0.5 | instance_miou | 0.5 | 0.6\n");
    let (tables, missing) = read(&dir, &plan).unwrap();
    assert!(missing.is_empty());
    let rows = &tables[0].rows;
    let miou = rows[0].results["0.5"]["instance_miou"];
    // Values 0.1, 0.2, 0.3, 0.4: deviation sqrt(0.05 / 3), over sqrt(4), times t of 3.
    assert!((miou.mean - 0.25).abs() < 1e-12 && miou.n == 4);
    assert!((miou.half.unwrap() - 3.1824 * (0.05f64 / 3.0).sqrt() / 2.0).abs() < 1e-9);
    let gain = rows[1].differences["0.5"]["instance_miou"];
    assert!((gain.mean - 0.3).abs() < 1e-12 && gain.half.unwrap() < 1e-9, "the same in every scene: {gain:?}");
    assert!(rows[0].differences.is_empty() && !rows[0].results["0"].contains_key("query_miou"));
    assert_eq!(rows[1].options, ["--gate 0.7", "--method spectral", "--cluster free"]);
    let md = markdown(&tables[0]);
    assert!(md.contains("| full | 50.79 / 69.62 | 25.0 ± 20.5 |") && md.contains("| +30.0 ± 0.0 |"), "{md}");
    assert!(md.contains("| ours | 55.0 ± 20.5 | 55.0 ± 20.5 |"), "by p: {md}");
    let json = serde_json::to_string(&tables[0]).unwrap();
    assert_eq!(serde_json::from_str::<Table>(&json).unwrap().rows.len(), 2);
}

#[test]
fn what_is_missing_is_counted_and_what_is_not_expected_is_refused() {
    let (dir, plan) = runs("");
    std::fs::remove_file(dir.path().join("b-1/p0.5/ours.free.score.json")).unwrap();
    let (tables, missing) = read(&dir, &plan).unwrap();
    assert_eq!((missing.len(), tables[0].missing), (1, 1));
    let (result, gain) = (&tables[0].rows[1].results["0.5"], &tables[0].rows[1].differences["0.5"]);
    assert_eq!((result["instance_miou"].n, gain["instance_miou"].n), (3, 3));
    assert!((gain["instance_miou"].mean - 0.3).abs() < 1e-12, "pairs only");
    assert!(markdown(&tables[0]).contains("1 runs are missing"));

    for (expect, word) in [
        ("expect t | ours.free | 0.5 | instance_miou | 0.6 | 0.9\n", "found 0.5500, expected 0.6 to 0.9"),
        ("expect t | ours.free | 0.5 | query_miou | 0 | 1\n", "no such result"),
        ("expect t | other.free | 0.5 | instance_miou | 0 | 1\n", "no such result"),
    ] {
        let (dir, plan) = runs(expect);
        let e = read(&dir, &plan).unwrap_err().to_string();
        assert!(e.contains(word), "{e}");
    }
    std::fs::write(dir.path().join("a-0/p0/ours.free.score.json"), "{").unwrap();
    assert!(read(&dir, &plan).unwrap_err().to_string().contains("ours.free.score.json"));
    let empty = tempfile::tempdir().unwrap();
    assert!(read(&empty, &plan).unwrap_err().to_string().contains("no run of the plan"));
}

#[test]
fn documents_are_filled_between_marks() {
    let (dir, plan) = runs("");
    let (tables, _) = read(&dir, &plan).unwrap();
    let document = "before\n<!-- ablation t -->old<!-- end -->\nbetween <!-- ablation u -->kept<!-- end --> after";
    let (filled, unknown) = fill(document, &tables).unwrap();
    assert!(filled.starts_with("before\n<!-- ablation t -->\n") && !filled.contains("old"), "{filled}");
    assert!(filled.contains("| ours |") && filled.ends_with("<!-- ablation u -->kept<!-- end --> after"));
    assert_eq!(unknown, ["u"]);
    assert_eq!(fill(&filled, &tables).unwrap().0, filled, "again, the same");
    assert!(fill("<!-- ablation t -->", &tables).is_err());
}

#[test]
fn tables_are_read_back_for_the_report() {
    let (dir, plan) = runs("");
    let (tables, _) = read(&dir, &plan).unwrap();
    let out = tempfile::tempdir().unwrap();
    assert!(Table::read_all(out.path()).is_err());
    std::fs::write(out.path().join("t.json"), serde_json::to_vec(&tables[0]).unwrap()).unwrap();
    std::fs::write(out.path().join("report.html.run.json"), "{}").unwrap();
    assert_eq!(Table::read_all(out.path()).unwrap()[0].rows[1].row.label, "ours");
    std::fs::write(out.path().join("u.json"), "{}").unwrap();
    assert!(Table::read_all(out.path()).unwrap_err().to_string().contains("u.json"));
}
