//! `explore page`: the page as one file, for a colleague without any of this.

use crate::options::PageOptions;
use crate::world::{Edited, World};
use crate::{answers, describe, pictures, web};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use gs_io::{Error, Result, write_bytes};
use gs_scene::dataset::Resolution;
use query::Index;
use serde_json::{Map, Value, json};
use stage::Stage;

/// What scripts, styles and pictures of the file may come from: itself. Nothing may be asked of any network.
const POLICY: &str = "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; script-src 'unsafe-inline' \
                      blob:; worker-src blob:; img-src data: blob:; style-src 'unsafe-inline'\">";
/// What is put in place of links.
const LINKED_STYLE: &str = "<link rel=\"stylesheet\" href=\"app/style.css\">";
const LINKED_SCRIPT: &str = "<script type=\"module\" src=\"app/main.js\"></script>";

/// Most photographs in the file, evenly spread over the views, and what wider ones are shrunk to.
const PHOTOGRAPHS: usize = 40;
const WIDTH: Resolution = Resolution::Width(480);

/// Writes the file.
pub fn run(o: &PageOptions, parameters: Value, stage: &Stage) -> Result<()> {
    let mut claim = stage.outputs(&o.out).file(&o.out).reads(o.source.files()).claim()?;
    let world = World::read(&o.source, WIDTH, stage)?;
    let edited = world.saved(world.edits_file()?)?;
    let texts = texts(&world, &edited, &o.text)?;
    let shown = spread(world.dataset.views.len(), PHOTOGRAPHS);
    let blob = describe::blob(&world);
    let scene = describe::scene(&world, &edited, &blob, "file", &shown);
    let pictures = pictures_of(&world, &edited, &shown, texts, stage)?;
    let page = assemble(&scene, &pictures, &blob.bytes)?;
    write_bytes(&o.out, page.as_bytes())?;
    let (gaussians, bytes) = (world.packed.order.len(), page.len());
    let summary = json!({"gaussians": gaussians, "bytes": bytes, "bytes_of_gaussians": blob.bytes.len(), "photographs": shown.len()});
    stage.record(&mut claim, parameters, world.scene.inputs.clone(), summary)?;
    let each = blob.bytes.len() as f64 / gaussians.max(1) as f64;
    stage.info(&format!("wrote {} ({:.1} MB; {each:.1} bytes a Gaussian)", o.out.display(), bytes as f64 / 1e6));
    Ok(())
}

/// What each text finds.
fn texts(world: &World, edited: &Edited, texts: &[String]) -> Result<Map<String, Value>> {
    let source = match (&world.words, texts) {
        (_, []) => return Ok(Map::new()),
        (Ok(source), _) => source,
        (Err(why), _) => return Err(Error::new("texts cannot be answered").field("--text").hint(why.clone())),
    };
    let features = source.known(&[], texts, "--text")?;
    Ok(texts.iter().zip(features).map(|(t, f)| (t.clone(), json!(answers::answer(world, edited, t, &f)))).collect())
}

/// At most `most` of `count` numbers, evenly spread.
fn spread(count: usize, most: usize) -> Vec<usize> {
    let k = count.min(most);
    (0..k).map(|i| (2 * i + 1) * count / (2 * k)).collect()
}

/// Photographs and thumbnails as data URLs, with the answers to texts.
fn pictures_of(
    world: &World,
    edited: &Edited,
    shown: &[usize],
    texts: Map<String, Value>,
    stage: &Stage,
) -> Result<Value> {
    let index = Index::new(&edited.instances);
    let best = pictures::best_views(world, &edited.instances);
    let (mut photographs, mut thumbnails) = (Map::new(), Map::new());
    let url = |jpeg: Vec<u8>| Value::from(format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg)));
    let mut progress = stage.progress("photographs", world.dataset.views.len() as u64);
    for (k, view) in world.dataset.views.iter().enumerate() {
        stage.go_on()?;
        let here: Vec<usize> = (0..best.len()).filter(|&i| best[i] == Some(k)).collect();
        if shown.contains(&k) {
            photographs.insert(k.to_string(), url(pictures::photograph(view)?));
        }
        if !here.is_empty() {
            let photograph = view.load_image()?;
            for i in here {
                let members = index.members(&[i as u32]);
                let picture = pictures::thumbnail(&photograph, view, world.gaussians(), &members)?;
                thumbnails.insert(i.to_string(), url(picture));
            }
        }
        progress.step();
    }
    progress.finish(&[]);
    Ok(json!({"photographs": photographs, "thumbnails": thumbnails, "texts": texts}))
}

/// One file of the page's parts.
fn assemble(scene: &Value, pictures: &Value, bytes: &[u8]) -> Result<String> {
    let (Some(_), Some(_)) = (web::INDEX.find(LINKED_STYLE), web::INDEX.find(LINKED_SCRIPT)) else {
        return Err(Error::new("the page's links have changed: this is a fault of the program"));
    };
    // Within a script no text may look like its end.
    let quiet = |v: &Value| v.to_string().replace('<', "\\u003c");
    let data = format!(
        "<script type=\"application/json\" id=\"scene-json\">{}</script>\n\
         <script type=\"application/json\" id=\"pictures-json\">{}</script>\n\
         <script type=\"text/plain\" id=\"scene-bin\">{}</script>\n",
        quiet(scene),
        quiet(pictures),
        STANDARD.encode(bytes)
    );
    let style = format!("{POLICY}\n<style>\n{}</style>", web::STYLE);
    let script = format!("{data}<script type=\"module\">\n{}</script>", web::bundle());
    Ok(web::INDEX.replace(LINKED_STYLE, &style).replace(LINKED_SCRIPT, &script))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photographs_are_spread() {
        assert_eq!(spread(30, 3), [5, 15, 25]);
        assert_eq!(spread(2, 40), [0, 1]);
        assert!(spread(5, 0).is_empty() && spread(0, 5).is_empty());
    }

    #[test]
    fn the_file_holds_everything_and_asks_nobody() {
        let scene = json!({"name": "</script><b>"});
        let page = assemble(&scene, &json!({}), &[1, 2, 3]).unwrap();
        assert!(page.contains("AQID") && !page.contains("</script><b>"));
        for asked in ["src=\"app", "href=\"app", "https://", "import {", "export "] {
            assert!(!page.contains(asked), "{asked}");
        }
    }

    #[test]
    fn no_two_modules_use_one_name() {
        let mut names = std::collections::BTreeSet::new();
        for line in web::bundle().lines() {
            let name =
                ["const ", "function ", "class ", "async function ", "let "].iter().find_map(|k| line.strip_prefix(k));
            for name in name.into_iter().flat_map(|n| n.split(['(', ' ', '=']).next()) {
                assert!(names.insert(name.to_string()), "{name} stands in two modules");
            }
        }
        assert!(names.len() > 20);
    }
}
