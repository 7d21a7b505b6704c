//! `eval ablation`: scores of a plan's runs become tables, a page, and a filled document.

use crate::fixture::Fixture;
use std::fs;

const PLAN: &str = "scene room | --objects 3\nseeds | 0 1\nfootprints gated | --gate 0.7\n\
    features paper | gated | --preset paper\nclustering free | --cluster free\ntable layers | 0.5 | - | Layers\n\
    row layers | paper | free | 50.79 69.62 2.1 | full <method>\n";

#[test]
fn an_ablation_makes_tables_and_fills_documents() {
    // One real score, as eval score writes it, and the same again for another seed.
    let f = Fixture::new(2);
    f.good("score", "--text-features|{}/text.json|--out|{}/score.json");
    let run = |seed: usize| f.path().join(format!("runs/room-{seed}/p0.5"));
    for seed in [0, 1] {
        fs::create_dir_all(run(seed)).unwrap();
        fs::copy(f.path().join("score.json"), run(seed).join("paper.free.score.json")).unwrap();
    }
    fs::write(f.path().join("plan"), PLAN).unwrap();
    fs::write(f.path().join("doc.md"), "a\n<!-- ablation layers --><!-- end -->\nz\n").unwrap();
    let arguments = "--plan|{}/plan|--runs|{}/runs|--out|{}/out|--docs|{}/doc.md";
    let printed = f.good("ablation", arguments);
    let scores = f.json("score.json");
    for key in ["instances_per_thing", "things_per_instance"] {
        assert!(scores[key].as_f64().unwrap() >= 1.0, "{key} of {scores}");
    }
    let found = &f.json("out/layers.json")["rows"][0]["results"]["0.5"]["instance_miou"];
    assert_eq!(found["mean"].as_f64(), scores["instance_miou"].as_f64());
    assert_eq!((found["half"].as_f64(), found["n"].as_u64()), (Some(0.0), Some(2)));
    let gaussians = &f.json("out/layers.json")["rows"][0]["results"]["0.5"]["gaussian_miou"];
    assert_eq!(gaussians["mean"].as_f64(), scores["gaussians"]["instance_miou"].as_f64());
    let md = fs::read_to_string(f.path().join("out/layers.md")).unwrap();
    assert!(md.contains("| full <method> | 50.79 / 69.62 |") && printed.contains("| full <method> |"), "{md}");
    let document = fs::read_to_string(f.path().join("doc.md")).unwrap();
    assert!(document.starts_with("a\n<!-- ablation layers -->\n") && document.contains("| full <method> |"));
    let page = fs::read_to_string(f.path().join("out/report.html")).unwrap();
    assert!(page.contains("id=\"ablation-layers\"") && page.contains("full &lt;method&gt;"));

    // What is wrong is said, and nothing is overwritten.
    fs::remove_dir_all(run(1)).unwrap();
    fs::write(f.path().join("plan"), format!("{PLAN}expect layers | paper.free | 0.5 | instance_miou | 2 | 3\n"))
        .unwrap();
    let before = fs::read(f.path().join("out/layers.json")).unwrap();
    assert!(f.bad("ablation", arguments).contains("expected 2 to 3"));
    assert_eq!(fs::read(f.path().join("out/layers.json")).unwrap(), before);
    fs::write(f.path().join("plan"), PLAN.replace("row layers", "row losses")).unwrap();
    assert!(f.bad("ablation", arguments).contains("no such table"));
    fs::write(f.path().join("plan"), PLAN).unwrap();
    fs::write(f.path().join("doc.md"), "<!-- ablation layers -->").unwrap();
    assert!(f.bad("ablation", arguments).contains("a block without end"));
}
