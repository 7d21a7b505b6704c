//! The page in a real browser: chromium with WebGL2 in software, driven through chromedriver.
//!
//! `scripts/test_explore.sh` runs these on the demo's scene; they need EXPLORE_RUN (a finished run with query/query.json) and
//! both programs. EXPLORE_SCREENSHOT names a file for a picture of the page.

#[path = "../common/mod.rs"]
mod common;
mod driver;

use artifacts::{Edits, InstanceNames, Instances};
use base64::Engine;
use common::{Run, SIZE};
use driver::{Session, down, move_to, up};
use gs_io::Result;
use gs_raster::RasterOptions;
use gs_scene::dataset::{self, LoadOptions};
use gs_scene::{Camera, Gaussians, Geometry};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// The folder that make runs in: records of runs name paths from there.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../..");
/// Least PSNR in dB between the page's picture of a camera and the rasteriser's, with the same bands of harmonics.
const PSNR: f64 = 35.0;
/// Size of the browser's window: small, because a processor draws the pictures.
const WINDOW: (u32, u32) = (680, 480);
/// Most seconds that a page may take to load the demo.
const LOAD_SECONDS: f64 = 20.0;

struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // With all that it started: a driver leaves its browser alone when it is killed.
        let _ = Command::new("kill").args(["--", &format!("-{}", self.0.id())]).status();
        let _ = self.0.wait();
    }
}

/// Starts a program and gives what stands in its output after `mark`, up to a space.
fn start(program: &str, arguments: &[&str], mark: &str) -> (Running, String) {
    let mut command = Command::new(program);
    command.current_dir(ROOT).process_group(0);
    let mut child = command.args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let out = BufReader::new(child.stdout.take().unwrap()).lines();
    let err = BufReader::new(child.stderr.take().unwrap()).lines();
    let (send, receive) = std::sync::mpsc::channel();
    let both: [Box<dyn Iterator<Item = std::io::Result<String>> + Send>; 2] = [Box::new(out), Box::new(err)];
    for lines in both {
        let send = send.clone();
        std::thread::spawn(move || lines.map_while(std::result::Result::ok).for_each(|l| drop(send.send(l))));
    }
    let running = Running(child);
    let mut said = String::new();
    while let Ok(line) = receive.recv_timeout(Duration::from_secs(60)) {
        if let Some((_, rest)) = line.split_once(mark) {
            return (running, rest.split(' ').next().unwrap_or_default().trim_end_matches('.').to_string());
        }
        said += &line;
    }
    panic!("{program} did not say {mark:?}: {said}");
}

struct Fixture {
    run: PathBuf,
    views: Vec<dataset::View>,
    geometry: Geometry,
    instances: Instances,
}

impl Fixture {
    fn read() -> Self {
        let run = PathBuf::from(std::env::var_os("EXPLORE_RUN").expect("EXPLORE_RUN: run scripts/test_explore.sh"));
        let geometry = Geometry::read(run.join("geometry.ply")).unwrap();
        let instances = Instances::read(run.join("instances.safetensors")).unwrap().0;
        let views = dataset::load(&run.join("scene"), &LoadOptions::default()).unwrap().views;
        Self { run, views, geometry, instances }
    }

    fn gaussians(&self) -> &Gaussians {
        &self.geometry.gaussians
    }

    fn raster(&self, degree: u8) -> RasterOptions {
        RasterOptions { sh_degree: degree, depth: false, ..RasterOptions::of(&self.geometry) }
    }

    /// The instance with the largest weight at a pixel, and its share of the pixel.
    fn instance_at(&self, camera: &Camera, pixel: [u32; 2]) -> Option<(i32, f64)> {
        let mut sums = std::collections::BTreeMap::<i32, f64>::new();
        for (i, w) in query::pixel_weights(self.gaussians(), camera, &self.raster(0), pixel) {
            *sums.entry(self.instances.label[i as usize]).or_default() += w;
        }
        sums.into_iter().max_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// For every instance that a view shows clearly: the view, and a pixel of it.
    fn places(&self) -> Vec<(u32, usize, [u32; 2])> {
        let mut places = Vec::new();
        for k in 0..self.instances.len() as u32 {
            let matches = self.instances.matches.iter().filter(|m| m.instance == k);
            let Some(best) = matches.max_by(|a, b| (a.score * a.visible).total_cmp(&(b.score * b.visible))) else {
                continue;
            };
            let stem = &self.instances.views[best.view as usize];
            let (view, v) = self.views.iter().enumerate().find(|(_, v)| v.stem() == stem).unwrap();
            let at = self.instances.centroid[k as usize].map(f64::from);
            let (x, y, _) = v.camera.project(at.into());
            // The page may be drawn with fewer pixels than the photograph has: what is around shows the same.
            let (w, h) = (f64::from(v.camera.width), f64::from(v.camera.height));
            let around =
                [(0.0, 0.0), (-3.0, 0.0), (3.0, 0.0), (0.0, -3.0), (0.0, 3.0)].map(|(dx, dy)| (x + dx, y + dy));
            let clear = |&(x, y): &(f64, f64)| {
                let inside = x >= 0.0 && y >= 0.0 && x < w && y < h;
                inside
                    && self.instance_at(&v.camera, [x as u32, y as u32]).is_some_and(|(l, w)| l == k as i32 && w > 0.8)
            };
            if around.iter().all(clear) {
                places.push((k, view, [x as u32, y as u32]));
            }
        }
        places
    }
}

/// Where a picture of the page is wanted.
fn screenshot() -> Option<std::ffi::OsString> {
    std::env::var_os("EXPLORE_SCREENSHOT").filter(|p| !p.is_empty())
}

struct Browser {
    session: Session,
    _driver: Running,
}

impl Browser {
    fn open() -> Self {
        Self::in_colours("dark")
    }

    /// For a person who likes `dark` or `light`.
    fn in_colours(scheme: &str) -> Self {
        let (driver, port) = start("chromedriver", &["--port=0"], "successfully on port ");
        let arguments = [
            "--headless=new",
            "--no-sandbox",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--disable-dev-shm-usage",
            "--disable-background-networking",
            "--disable-component-update",
            "--no-first-run",
            if screenshot().is_some() { "--force-device-scale-factor=1" } else { "--force-device-scale-factor=0.5" },
            // Every name but this machine's is unknown: the network is cut.
            "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
        ];
        let size = format!("--window-size={},{}", WINDOW.0, WINDOW.1);
        let scheme = format!("--blink-settings=preferredColorScheme={}", u8::from(scheme == "light"));
        let arguments: Vec<&str> = arguments.into_iter().chain([&size[..], &scheme]).collect();
        let wanted = json!({"goog:chromeOptions": {"args": arguments}, "timeouts": {"script": 240_000}});
        Self { session: Session::new(&port, &wanted), _driver: driver }
    }

    /// Runs JavaScript that may await; `page` is the page's handle for tests.
    fn js(&self, body: &str, given: Vec<Value>) -> Value {
        let script = format!(
            "const done = arguments[arguments.length - 1], given = arguments, page = globalThis.explore; \
             (async () => {{ {body} }})().then((v) => done({{ v: v ?? null }}), (e) => done({{ e: String(e.stack ?? e) }}));"
        );
        let answer = self.session.execute_async(&script, &given);
        assert!(answer.get("e").is_none(), "{body}: {answer}");
        answer["v"].clone()
    }

    fn load(&self, url: &str) -> f64 {
        self.session.goto(url);
        for _ in 0..600 {
            // The page's script ran before the browser said that it is here.
            let state = self.js("return [page?.seconds ?? null, page?.errors ?? ['its script does not run']]", vec![]);
            assert_eq!(state[1], json!([]), "errors while loading {url}");
            if let Some(seconds) = state[0].as_f64() {
                return seconds;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
        panic!("{url} did not load in a minute");
    }

    /// The page's picture of one of the scene's cameras at its own size, without marks.
    fn picture(&self, view: usize) -> Vec<u8> {
        let script = "page.viewer.background = [0, 0, 0]; const camera = page.scene.cameras[given[0]]; \
                      await page.viewer.show(camera); const rgb = page.viewer.pixels(); let text = ''; \
                      for (let i = 0; i < rgb.length; i += 8192) text += String.fromCharCode(...rgb.subarray(i, i + 8192)); \
                      return btoa(text);";
        bytes(&self.js(script, vec![view.into()]))
    }

    /// A real click on what lies at a pixel of a view, after standing there.
    fn click(&self, view: usize, pixel: [u32; 2]) {
        self.session.mouse(&[self.over(view, pixel), down(), up()]);
        self.session.release();
    }

    /// Lets the pointer rest on a pixel of a view.
    fn point(&self, view: usize, pixel: [u32; 2]) {
        self.session.mouse(&[self.over(view, pixel)]);
    }

    /// Drags the mouse along points of the window.
    fn drag(&self, along: &[[f64; 2]]) {
        let mut mouse: Vec<Value> = along.iter().map(|&place| move_to(place)).collect();
        mouse.insert(1, down());
        mouse.push(up());
        self.session.mouse(&mouse);
        self.session.release();
    }

    /// The pointer over a pixel of a view, from which the page then looks.
    fn over(&self, view: usize, pixel: [u32; 2]) -> Value {
        move_to(self.place(view, pixel))
    }

    /// Where a pixel of a view is in the window, as the page looks from there.
    fn place(&self, view: usize, pixel: [u32; 2]) -> [f64; 2] {
        let script = "page.jump(given[0]); await page.viewer.busy; const c = page.viewer.camera, o = page.scene.cameras[given[0]]; \
                      const canvas = document.getElementById('canvas'), rect = canvas.getBoundingClientRect(), s = rect.width / c.width; \
                      const x = (given[1] + 0.5 - o.cx) / o.fx * c.fx + c.cx, y = (given[2] + 0.5 - o.cy) / o.fy * c.fy + c.cy; \
                      return [Math.round(rect.left + x * s), Math.round(rect.top + y * s)];";
        let at = self.js(script, vec![view.into(), pixel[0].into(), pixel[1].into()]);
        serde_json::from_value(at).unwrap()
    }

    /// Waits until `condition`, JavaScript, is true.
    fn until(&self, condition: &str) {
        for _ in 0..300 {
            if self.js(&format!("return Boolean({condition})"), vec![]) == json!(true) {
                return;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
        panic!(
            "never: {condition}; {}",
            self.js("return [page.errors, document.getElementById('hint').textContent]", vec![])
        );
    }

    fn selected(&self) -> Vec<u32> {
        let ids = self.js("await page.viewer.busy; return page.selectedInstances()", vec![]);
        serde_json::from_value(ids).unwrap()
    }

    fn ask(&self, text: &str) {
        self.session.clear("text");
        self.session.keys("text", &format!("{text}\u{e007}"));
        self.until(&format!("page.state.answer?.text === {}", json!(text)));
    }

    fn saved(&self, action: &str) -> Vec<u8> {
        let script = "page.saved = null; await page.act(given[0]); const b = new Uint8Array(await page.saved.blob.arrayBuffer()); \
                      let text = ''; for (let i = 0; i < b.length; i += 8192) text += String.fromCharCode(...b.subarray(i, i + 8192)); return btoa(text);";
        bytes(&self.js(script, vec![action.into()]))
    }

    fn no_errors(&self) {
        assert_eq!(self.js("return page.errors", vec![]), json!([]));
    }
}

fn bytes(base64: &Value) -> Vec<u8> {
    base64::engine::general_purpose::STANDARD.decode(base64.as_str().unwrap()).unwrap()
}

fn psnr(a: &[u8], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let squares = a.iter().zip(b).map(|(&a, &b)| (f64::from(a) / 255.0 - f64::from(b.clamp(0.0, 1.0))).powi(2));
    -10.0 * (squares.sum::<f64>() / a.len() as f64).log10()
}

fn read_ply(bytes: &[u8]) -> Gaussians {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), bytes).unwrap();
    gs_scene::ply::read_gaussians(file.path()).unwrap()
}

/// What `eval query` answered: text, selected instances, PLY; none of either where nothing matches.
fn answers(run: &Path) -> Vec<(String, Vec<u32>, Option<Gaussians>)> {
    let all: Value = serde_json::from_slice(&std::fs::read(run.join("query/query.json")).unwrap()).unwrap();
    let one = |q: &Value| {
        let ply = q["ply"].as_str().map(|p| gs_scene::ply::read_gaussians(run.join("query").join(p)).unwrap());
        let selected: Vec<u32> = serde_json::from_value(q["selected"].clone()).unwrap();
        assert_eq!(selected.is_empty(), ply.is_none(), "{q}");
        (q["text"].as_str().unwrap().to_string(), selected, ply)
    };
    let all: Vec<_> = all["queries"].as_array().unwrap().iter().map(one).collect();
    assert!(all.iter().any(|(.., ply)| ply.is_some()), "some text of the run matches");
    all
}

fn explore() -> &'static str {
    env!("CARGO_BIN_EXE_explore")
}

/// The pictures of a few views are the rasteriser's.
fn pictures_agree(browser: &Browser, f: &Fixture, degree: u8) {
    browser.js("await page.select([]); page.setColors('photograph'); return null", vec![]);
    for view in [0, f.views.len() / 2] {
        let shown = browser.picture(view);
        let rendered = gs_raster::render(f.gaussians(), &f.views[view].camera, &f.raster(degree));
        let found = psnr(&shown, &rendered.rgb);
        eprintln!("view {view}, degree {degree}: {found:.1} dB");
        assert!(found >= PSNR, "view {view}: {found:.1} dB");
    }
    // The same Gaussians as if they had been learnt with the 2D filter of Mip-Splatting.
    browser.js("page.gaussians.antialias = true", vec![]);
    let shown = browser.picture(0);
    browser.js("page.gaussians.antialias = false", vec![]);
    let filtered = RasterOptions { antialias: true, ..f.raster(degree) };
    let found = psnr(&shown, &gs_raster::render(f.gaussians(), &f.views[0].camera, &filtered).rgb);
    assert!(found >= PSNR, "antialiased: {found:.1} dB");
}

/// Clicks on things that are seen clearly select them.
fn clicks_select(browser: &Browser, f: &Fixture, most: usize) {
    let places = f.places();
    assert!(places.len() >= 10, "only {} instances are seen clearly", places.len());
    for &(instance, view, pixel) in &places {
        let script = "return (await page.pick(page.scene.cameras[given[0]], given[1], given[2])).instance";
        let found = browser.js(script, vec![view.into(), pixel[0].into(), pixel[1].into()]);
        assert_eq!(found, json!(instance), "view {view}, pixel {pixel:?}");
    }
    for (instance, view, pixel) in places.into_iter().take(most) {
        browser.js("await page.select([])", vec![]);
        browser.click(view, pixel);
        browser.until("page.selectedInstances().length");
        assert_eq!(browser.selected(), [instance], "view {view}, pixel {pixel:?}");
    }
}

#[test]
#[ignore = "needs chromium and a finished run; run scripts/test_explore.sh"]
fn a_served_scene_can_be_seen_clicked_asked_and_edited() {
    let f = Fixture::read();
    let edits = f.run.join("instances.edits.json");
    let _ = std::fs::remove_file(&edits);
    let run = f.run.to_str().unwrap();
    let (_server, url) = start(explore(), &["serve", "--run-dir", run, "--port", "0"], "look at ");
    let browser = Browser::open();
    let seconds = browser.load(&url);
    eprintln!("loaded in {seconds:.1} s");
    assert!(seconds < LOAD_SECONDS, "{seconds}");
    pictures_agree(&browser, &f, 0);
    clicks_select(&browser, &f, usize::MAX);

    names_are_listed_and_hovered(&browser, &f);

    // A text selects what eval query selects, and what is saved are the same Gaussians.
    for (text, selected, gaussians) in answers(&f.run) {
        browser.ask(&text);
        assert_eq!(browser.selected(), selected, "{text}");
        let Some(gaussians) = gaussians else { continue };
        assert_eq!(read_ply(&browser.saved("save-selection")), gaussians, "{text}");
        let rest = read_ply(&browser.saved("save-rest"));
        assert_eq!(rest.len() + gaussians.len(), f.gaussians().len());
    }
    if let Some(path) = screenshot() {
        browser.session.resize(1200, 800);
        // A thing with a note, and a lasso half drawn around it.
        let script = "const k = page.selectedInstances()[0] ?? 0; await page.edit({ op: 'note', instance: k, text: 'From grandma. One wheel is new.' }); \
                      await page.selectInstances([k]); await page.act('add'); page.jump(page.instances.views(k)[0][0]); await page.viewer.busy; \
                      const stage = document.getElementById('stage'), c = page.visitor.camera(stage.clientWidth, stage.clientHeight); \
                      const t = [0, 1, 2].map((i) => page.row(c.rotation, i).reduce((sum, v, j) => sum + v * page.instances.extent(page.state.cells).center[j], c.translation[i])); \
                      const [x, y, r] = [c.fx * t[0] / t[2] + c.cx, c.fy * t[1] / t[2] + c.cy, 0.13 * c.height]; \
                      page.state.path = Array.from({ length: 40 }, (_, n) => [x + r * (1 + 0.1 * Math.sin(n / 2)) * Math.cos(n / 6.4), y + r * Math.sin(n / 6.4)]); \
                      await page.refresh(); await page.viewer.busy;";
        browser.js(script, vec![]);
        std::fs::write(path, bytes(&browser.session.screenshot())).unwrap();
        browser.js("await page.act('show-all'); await page.act('undo')", vec![]);
    }

    // Hidden, what lies behind shows; isolated, nothing else does.
    let count = |place: &(u32, usize, [u32; 2])| f.instances.count[place.0 as usize];
    let (instance, view, pixel) = f.places().into_iter().min_by_key(count).unwrap();
    let at = 3 * (pixel[1] * f.views[view].camera.width + pixel[0]) as usize;
    browser.js("await page.selectInstances([given[0]])", vec![instance.into()]);
    browser.js("await page.select([])", vec![]);
    let whole = browser.picture(view);
    browser.js("await page.selectInstances([given[0]]); await page.act('isolate')", vec![instance.into()]);
    let alone = browser.picture(view);
    let lit = |picture: &[u8]| picture.chunks(3).filter(|c| c.iter().any(|&v| v > 8)).count();
    assert!(
        lit(&alone) < lit(&whole) / 2 && alone[at..at + 3].iter().any(|&v| v > 8),
        "isolated: {} of {}",
        lit(&alone),
        lit(&whole)
    );
    browser.js("await page.act('isolate'); await page.act('hide')", vec![]);
    let without = browser.picture(view);
    let change: i32 = (at..at + 3).map(|k| (i32::from(without[k]) - i32::from(whole[k])).abs()).sum();
    let same = without
        .chunks(3)
        .zip(whole.chunks(3))
        .filter(|(a, b)| a.iter().zip(*b).all(|(x, y)| x.abs_diff(*y) < 3))
        .count();
    assert!(change > 15 && same * 3 > whole.len() / 2, "hidden: changed by {change}, {same} pixels stayed");
    let script = "return (await page.pick(page.scene.cameras[given[0]], given[1], given[2])).instance";
    let clicked = browser.js(script, vec![view.into(), pixel[0].into(), pixel[1].into()]);
    assert_ne!(clicked, json!(instance), "what is hidden is not clicked");
    browser.js("await page.act('show-all')", vec![]);

    let script = "try { new page.viewer.constructor({ getContext: () => null }); } catch (e) { return e.message; }";
    assert!(browser.js(script, vec![]).as_str().unwrap().contains("no WebGL2"));
    edits_are_those_of_the_stages(&browser, &f, &edits);
    browser.no_errors();
}

#[test]
#[ignore = "needs chromium; run scripts/test_explore.sh"]
fn a_click_is_answered_while_the_first_text_is_encoded() {
    let browser = Browser::open();
    let run = Run::with_slow_words();
    let server = run.serve(&[]);
    browser.load(&format!("http://{}{}", server.host, server.path));
    let there = browser.over(0, [SIZE.0 / 2, SIZE.1 / 2]);
    browser.session.keys("text", "mug\u{e007}");
    browser.session.mouse(&[there, down(), up()]);
    browser.until("page.selectedInstances().length");
    assert_eq!(browser.selected(), [0]);
    assert_eq!(browser.js("return page.state.answer", vec![]), Value::Null, "the text is still encoded");
    browser.until("page.state.answer?.text === 'mug'");
    browser.no_errors();
}

/// A small run with names, its server, where that is, and a browser that has loaded it.
fn open_named() -> (Run, common::Server, String, Browser) {
    let run = Run::new();
    run.write_names(&run.instances());
    let server = run.serve(&[]);
    let url = format!("http://{}{}", server.host, server.path);
    let browser = Browser::open();
    browser.load(&url);
    (run, server, url, browser)
}

/// A note is typed without a mouse, kept in the run's folder, shown as text, and undone like any edit.
#[test]
#[ignore = "needs chromium; run scripts/test_explore.sh"]
fn notes_are_kept_and_shown() {
    let (run, _server, url, browser) = open_named();
    browser.js("await page.selectInstances([0])", vec![]);
    let note = "<b>grandma's</b>, 👩‍🍳 میراث";
    browser.session.keys("canvas", "o");
    browser.until("document.getElementById('ask').open");
    browser.session.keys("ask-value", &format!("{note}\u{e007}"));
    browser.until("document.getElementById('note').textContent");
    let shown = "await page.act('inventory'); const at = (q) => document.querySelector(q)?.textContent ?? null; return [at('#note'), at('#ranking span small'), at('b')]";
    let path = run.out().join("instances.edits.json");
    let there = json!([note, note, null]);
    assert_eq!(browser.js(shown, vec![]), there);
    let kept = artifacts::Edit::Note { instance: 0, text: note.into() };
    assert_eq!(Edits::read(&path).unwrap().edits, [kept]);
    browser.js("await page.act('undo')", vec![]);
    assert_eq!(browser.js(shown, vec![]), json!(["", null, null]));
    browser.js("await page.act('redo')", vec![]);
    browser.load(&url);
    browser.js("await page.selectInstances([0])", vec![]);
    assert_eq!(browser.js(shown, vec![]), there);
    // A long one is refused where there is no server, too.
    let long = json!({"op": "note", "instance": 0, "text": "é".repeat(251)});
    let said = browser.js("return page.instances.edit(given[0])", vec![long]);
    assert_eq!(said, json!("This is too long: it has 502 bytes, and 500 at most are kept."));
    browser.no_errors();
}

/// The list of a search calls things as the inventory does, a guess with a question mark, until a person knows better.
#[test]
#[ignore = "needs chromium; run scripts/test_explore.sh"]
fn the_list_has_the_names_of_the_inventory() {
    let (_run, _server, _, browser) = open_named();
    browser.ask("far ball");
    let listed = "return [...document.querySelectorAll('#ranking button')].map((b) => b.children[1].textContent).concat(document.getElementById('selection-name').textContent)";
    browser.until("document.getElementById('selection-name').textContent");
    assert_eq!(browser.js(listed, vec![]), json!(["planet?", "sun", "planet?"]));
    browser.js("await page.edit({ op: 'rename', instance: 1, name: 'my moon' })", vec![]);
    assert_eq!(browser.js(listed, vec![]), json!(["my moon", "sun", "my moon"]));
    browser.js("await page.act('undo')", vec![]);
    assert_eq!(browser.js(listed, vec![]), json!(["planet?", "sun", "planet?"]));
    browser.no_errors();
}

/// What a mouse can do is done with keys: each control is reached in the order of the page, says its name and shows its focus.
#[test]
#[ignore = "needs chromium; run scripts/test_explore.sh"]
fn keys_reach_everything() {
    let (_run, _server, _, browser) = open_named();
    browser.session.keys("canvas", "t");
    browser.until("document.querySelector('#ranking button')");
    // Along the list by arrows, which leave the camera where it is.
    let eye = browser.js("document.querySelector('#ranking button').focus(); return page.visitor.eye", vec![]);
    browser.session.press("\u{e015}\u{e015}\u{e013}\u{e015}\u{e007}");
    browser.until("page.selectedInstances().length");
    let names = "return [document.activeElement.children[1].textContent, document.getElementById('said').textContent]";
    let names = browser.js(names, vec![]);
    assert!(names[0] == "sun" && names[1].as_str().unwrap().starts_with("sun. 1 Gaussians, "), "{names}");
    // Tab, from the start of the page to its end.
    browser.js("await page.selectInstances([1], { clicked: 1 }); document.getElementById('text').focus()", vec![]);
    let mut order = Vec::new();
    for _ in 0..60 {
        let at = "const e = document.activeElement, style = getComputedStyle(e); const name = e.labels?.[0]?.textContent || e.ariaLabel || e.title || e.textContent.trim() || e.querySelector('img')?.alt; \
                  return e === document.body ? null : [e.id || e.closest('[id]').id, style.outlineStyle === 'solid' && parseFloat(style.outlineWidth) >= 1.5, Boolean(name)]";
        let at = browser.js(at, vec![]);
        if at.is_null() || (!order.is_empty() && at[0] == "text") {
            break;
        }
        assert!(at[1] == json!(true) && at[2] == json!(true), "focus seen, name: {at}");
        order.push(at[0].as_str().unwrap().to_string());
        browser.session.press("\u{e004}");
    }
    order.dedup();
    let wanted = "text help-button canvas ranking level isolate ghost hide frame rename annotate split add remove save-selection save-rest \
                  save-json photographs show-all inventory measure scale picture colors view blend";
    assert_eq!(order.join(" "), wanted);
    // A slider moves by arrows, and not the camera.
    browser.js("document.getElementById('level').focus()", vec![]);
    browser.session.press("\u{e012}");
    browser.until("page.state.cells.size === 1");
    assert_eq!(browser.js("return page.visitor.eye", vec![]), eye);
    // What is no more there does not keep the focus; Escape leaves a tool.
    browser.js("document.getElementById('hide').focus()", vec![]);
    browser.session.press("\u{e007}");
    browser.until("document.getElementById('details').hidden");
    assert_eq!(browser.js("return document.activeElement.id", vec![]), json!("canvas"));
    browser.session.press("u");
    browser.until("page.state.tool === 'measure'");
    browser.session.press("\u{e00c}");
    browser.until("page.state.tool === 'select'");
    browser.no_errors();
}

/// axe-core, which `scripts/test_explore.sh` fetches, finds nothing against WCAG 2.2 A and AA in any state of the page.
#[test]
#[ignore = "needs chromium and axe-core; run scripts/test_explore.sh"]
fn everybody_can_use_it() {
    let axe = std::env::var("EXPLORE_AXE").expect("EXPLORE_AXE: run scripts/test_explore.sh");
    let axe = std::fs::read_to_string(axe).unwrap();
    let run = Run::new();
    run.write_names(&run.instances());
    let server = run.serve(&[]);
    let mut wrong = Vec::new();
    for scheme in ["dark", "light"] {
        let browser = Browser::in_colours(scheme);
        browser.load(&format!("http://{}{}", server.host, server.path));
        browser.session.execute(&axe);
        let as_asked = format!("return matchMedia('(prefers-color-scheme: {scheme})').matches");
        assert_eq!(browser.js(&as_asked, vec![]), json!(true), "{scheme}");
        for (state, enter) in [
            ("start", ""),
            ("inventory", "await page.act('inventory')"),
            ("selected", "await page.selectInstances([1])"),
            ("found", "await page.find('far ball')"),
            ("several selected", "await page.selectInstances([0, 1])"),
            ("tool", "await page.act('measure')"),
            ("lasso", "await page.selectInstances([1]); await page.act('add')"),
            ("asked", "page.act('annotate')"),
            ("answered", "document.getElementById('ask').close(); await page.act('show-all')"),
            ("wrong", "await page.find('zebra')"),
            ("help", "document.getElementById('help-button').click()"),
        ] {
            let check = "const levels = ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'wcag22aa']; \
                         const { violations, passes } = await axe.run({ runOnly: levels }); if (!passes.length) throw new Error('nothing was checked'); \
                         return violations.map((v) => `${v.id}: ${v.help}: ${v.nodes.map((n) => `${n.html} (${n.failureSummary})`).join(' | ')}`)";
            let found = browser.js(&format!("{enter}; await page.viewer.busy; {check}"), vec![]);
            wrong.extend(found.as_array().unwrap().iter().map(|v| format!("{scheme}, {state}: {v}")));
        }
        browser.no_errors();
    }
    assert!(wrong.is_empty(), "{} violations:\n{}", wrong.len(), wrong.join("\n"));
}

/// Everything stands in the list of what is here, under the names of `names.json`; the pointer tells a thing's name.
fn names_are_listed_and_hovered(browser: &Browser, f: &Fixture) {
    let hash = Instances::read(f.run.join("instances.safetensors")).unwrap().1.hash().to_string();
    let names = InstanceNames::read(f.run.join("names.json"), &hash).unwrap();
    let listed = "await page.act('inventory'); return [...document.querySelectorAll('#ranking button')].map((b) => [b.children[1].textContent, b.children[2].textContent])";
    let rows: Vec<[String; 2]> = serde_json::from_value(browser.js(listed, vec![])).unwrap();
    let count = |row: &[String; 2]| row[1].strip_prefix("× ").unwrap().parse::<usize>().unwrap();
    assert_eq!(rows.iter().map(count).sum::<usize>(), f.instances.count.iter().filter(|&&n| n > 0).count(), "{rows:?}");
    browser.js("document.querySelector('#ranking button').click(); await page.viewer.busy", vec![]);
    browser.until("page.selectedInstances().length");
    let selected = browser.selected();
    assert_eq!(selected.len(), count(&rows[0]));
    assert!(selected.iter().all(|&k| names.best(k).is_some_and(|c| c.name == rows[0][0])), "{selected:?} {rows:?}");
    browser.js("await page.select([])", vec![]);
    let named = f.places().into_iter().find_map(|(k, view, pixel)| Some((names.best(k)?, view, pixel)));
    let (called, view, pixel) = named.unwrap();
    browser.point(view, pixel);
    browser.until(&format!("document.getElementById('canvas').title === {}", json!(called.to_string())));
}

/// Merging, naming, splitting and the scale: the page's labels are those of `artifacts::Edits`, also after undo and redo.
fn edits_are_those_of_the_stages(browser: &Browser, f: &Fixture, path: &Path) {
    let split = (0..f.instances.len())
        .find(|&k| f.instances.count[k] > 0 && f.instances.family(k).is_some_and(|x| x.parts.len() > 1));
    let others: Vec<u32> = (0..f.instances.len() as u32).filter(|&k| Some(k as usize) != split).take(3).collect();
    let mut wanted = vec![
        json!({"op": "merge", "instances": [others[0], others[1]]}),
        json!({"op": "rename", "instance": others[2], "name": "grandma's kettle"}),
        json!({"op": "note", "instance": others[2], "text": "grandma's"}),
        json!({"op": "scale", "from": [0.0, 0.0, 0.0], "to": [2.0, 0.0, 0.0], "metres": 1.0}),
    ];
    wanted.extend(split.map(|k| json!({"op": "split", "instance": k})));
    for edit in &wanted {
        browser.js("await page.edit(given[0])", vec![edit.clone()]);
    }
    let saved = Edits::read(path).unwrap();
    assert_eq!(saved.edits.len(), wanted.len());
    let mut edited = f.instances.clone();
    let remarks = saved.apply(&mut edited, &f.gaussians().means).unwrap();
    assert_eq!(remarks.names[&others[2]], "grandma's kettle");
    let page = browser.js("return [page.scene.cells, [...page.instances.label], page.instances.metresPerUnit]", vec![]);
    let cells: Vec<(i32, i32)> = serde_json::from_value(page[0].clone()).unwrap();
    let labels: Vec<i32> = serde_json::from_value(page[1].clone()).unwrap();
    for i in 0..edited.label.len() {
        let own = (f.instances.label[i], f.instances.node[i]);
        let cell = cells.iter().position(|c| *c == own).unwrap();
        assert_eq!(labels[cell], edited.label[i], "Gaussian {i} of {own:?}");
    }
    assert_eq!(page[2].as_f64(), remarks.metres_per_unit);
    browser.ask("grandma");
    assert_eq!(browser.selected(), [others[2]], "a name that a person gave is found");
    // Undone to the start and done again.
    for _ in &wanted {
        browser.js("await page.act('undo')", vec![]);
    }
    assert_eq!(Edits::read(path).unwrap().edits.len(), 0);
    let label = browser.js("return [...page.instances.label]", vec![]);
    assert_eq!(label, json!(cells.iter().map(|c| c.0).collect::<Vec<_>>()));
    for _ in &wanted {
        browser.js("await page.act('redo')", vec![]);
    }
    assert_eq!(Edits::read(path).unwrap(), saved);
    // The page starts from what was saved.
    browser.session.refresh();
    browser.until("globalThis.explore?.seconds");
    assert_eq!(browser.js("return page.instances.edits.length", vec![]), json!(wanted.len()));
    // What another program did meanwhile stays, and the page's edit comes after it; it may not be undone unseen.
    let mut elsewhere = Edits::read(path).unwrap();
    elsewhere.edits.push(artifacts::Edit::Rename { instance: others[0], name: "theirs".into() });
    elsewhere.write(path).unwrap();
    let mine = json!({"op": "rename", "instance": others[2], "name": "mine"});
    browser.js("await page.edit(given[0])", vec![mine]);
    let both = Edits::read(path).unwrap();
    assert_eq!(both.edits[..wanted.len() + 1], elsewhere.edits);
    assert_eq!(both.edits.len(), wanted.len() + 2);
    assert_eq!(browser.js("return page.instances.edits.length", vec![]), json!(both.edits.len()));
    elsewhere.write(path).unwrap();
    browser.js("await page.act('undo')", vec![]);
    assert_eq!(Edits::read(path).unwrap(), elsewhere);
    assert_eq!(browser.js("return page.instances.edits.length", vec![]), json!(elsewhere.edits.len()));
    std::fs::remove_file(path).unwrap();
}

/// A lasso drawn with the mouse takes from an instance what is seen within it, and gives it what is another's; both are in the file, can
/// be undone and done again, and are there when the page is opened again, from a server or a file.
#[test]
#[ignore = "needs chromium and a finished run; run scripts/test_explore.sh"]
fn a_lasso_corrects_an_instance() {
    let f = &Fixture::read();
    let path = &f.run.join("instances.edits.json");
    let _ = std::fs::remove_file(path);
    let (_server, url) = start(explore(), &["serve", "--run-dir", f.run.to_str().unwrap(), "--port", "0"], "look at ");
    let browser = &Browser::open();
    browser.load(&url);
    let count = |place: &(u32, usize, [u32; 2])| f.instances.count[place.0 as usize];
    let (instance, view, pixel) = f.places().into_iter().max_by_key(count).unwrap();
    browser.js("await page.selectInstances([given[0]])", vec![instance.into()]);
    // A square of 60 pixels of the window around the pixel.
    let center = browser.place(view, pixel);
    let square =
        [[-30.0, -30.0], [30.0, -30.0], [30.0, 30.0], [-30.0, 30.0]].map(|[x, y]| [center[0] + x, center[1] + y]);
    let to_view = "const c = page.viewer.camera, o = page.scene.cameras[given[0]], rect = document.getElementById('canvas').getBoundingClientRect(), s = c.width / rect.width; \
                   return given[1].map(([x, y]) => [((x - rect.left) * s - c.cx) / c.fx * o.fx + o.cx, ((y - rect.top) * s - c.cy) / c.fy * o.fy + o.cy])";
    let corners = browser.js(to_view, vec![view.into(), json!(square)]);
    let corners: Vec<[f64; 2]> = serde_json::from_value(corners).unwrap();
    let camera = &f.views[view].camera;
    // Those with their centre well within that little lies before; with the transmittance before them.
    let within = |i: u32| {
        let (x, y, z) = camera.project(f.gaussians().means[i as usize].map(f64::from).into());
        z > 0.0
            && x > corners[0][0] - 5.0
            && x < corners[2][0] + 5.0
            && y > corners[0][1] - 5.0
            && y < corners[2][1] + 5.0
    };
    let before = |i: u32| {
        let (x, y, _) = camera.project(f.gaussians().means[i as usize].map(f64::from).into());
        let all = query::pixel_weights(f.gaussians(), camera, &f.raster(0), [x as u32, y as u32]);
        all.iter().take_while(|w| w.0 != i).map(|w| w.1).sum::<f64>()
    };
    let mut labels = f.instances.label.clone();
    for (tool, edits, to) in [("remove", 1, -1), ("add", 2, instance as i32)] {
        browser.js("await page.act(given[0])", vec![tool.into()]);
        browser.drag(&square);
        browser.until(&format!("page.instances.edits.length === {edits} && !page.viewer.busy"));
        let saved = Edits::read(path).unwrap();
        let mut edited = f.instances.clone();
        saved.apply(&mut edited, &f.gaussians().means).unwrap();
        let moved: Vec<u32> =
            (0..labels.len() as u32).filter(|&i| edited.label[i as usize] != labels[i as usize]).collect();
        eprintln!(
            "{tool}: {} Gaussians of {}, {} bytes",
            moved.len(),
            count(&(instance, view, pixel)),
            std::fs::metadata(path).unwrap().len()
        );
        assert!(moved.len() > 20, "{tool}: {moved:?}");
        for &i in &moved {
            assert_eq!(edited.label[i as usize], to);
            assert!(tool == "add" || labels[i as usize] == instance as i32);
            assert!(within(i), "{tool}: {i}; {corners:?}");
        }
        // The page is drawn with fewer pixels than the photograph has, so some differ.
        let hidden = moved.iter().filter(|&&i| before(i) > 0.95).count();
        assert!(hidden * 20 < moved.len(), "{tool}: {hidden} of {} lie behind something", moved.len());
        labels = edited.label;
        as_edited(browser, f, instance, &labels, true);
    }
    let saved = Edits::read(path).unwrap();
    for _ in 0..2 {
        browser.js("await page.act('undo')", vec![]);
    }
    as_edited(browser, f, instance, &f.instances.label, true);
    for _ in 0..2 {
        browser.js("await page.act('redo')", vec![]);
    }
    assert_eq!(Edits::read(path).unwrap(), saved);
    as_edited(browser, f, instance, &labels, true);
    browser.session.refresh();
    browser.until("globalThis.explore?.seconds");
    as_edited(browser, f, instance, &labels, true);
    // In a file edits can be undone, but there is nothing to draw with.
    let out = f.run.join("edited.html");
    let page = ["page", "--run-dir", f.run.to_str().unwrap(), "--overwrite", "--quiet", "--out", out.to_str().unwrap()];
    assert!(Command::new(explore()).current_dir(ROOT).args(page).status().unwrap().success());
    browser.load(&format!("file://{}", out.canonicalize().unwrap().display()));
    as_edited(browser, f, instance, &labels, false);
    browser.js("await page.act('undo'); await page.act('undo')", vec![]);
    as_edited(browser, f, instance, &f.instances.label, false);
    browser.js("await page.act('redo'); await page.act('redo')", vec![]);
    as_edited(browser, f, instance, &labels, false);
    assert_eq!(browser.js("return document.getElementById('add')", vec![]), Value::Null);
    std::fs::remove_file(path).unwrap();
    browser.no_errors();
}

/// The page has the Gaussians of an instance that these labels say, and saves them; a file only those that are drawn.
fn as_edited(browser: &Browser, f: &Fixture, instance: u32, labels: &[i32], served: bool) {
    let own: Vec<u32> = (0..labels.len() as u32).filter(|&i| labels[i as usize] == instance as i32).collect();
    let drawn = own.iter().filter(|&&i| f.gaussians().opacity(i as usize) >= 1.0 / 255.0).count();
    let script = "await page.selectInstances([given[0]]); return page.instances.extent(page.state.cells).count";
    assert_eq!(browser.js(script, vec![instance.into()]), json!(drawn));
    let saved = read_ply(&browser.saved("save-selection"));
    assert!(if served { saved == f.gaussians().select(&own) } else { saved.len() == drawn });
}

#[test]
#[ignore = "needs chromium and a finished run; run scripts/test_explore.sh"]
fn one_file_works_without_a_server() -> Result<()> {
    let f = Fixture::read();
    let out = f.run.join("page-test.html");
    let known = answers(&f.run);
    let mut arguments = vec![
        "page",
        "--run-dir",
        f.run.to_str().unwrap(),
        "--sh",
        "1",
        "--overwrite",
        "--quiet",
        "--out",
        out.to_str().unwrap(),
    ];
    known.iter().for_each(|(text, ..)| arguments.extend(["--text", text]));
    assert!(Command::new(explore()).current_dir(ROOT).args(&arguments).status().unwrap().success());
    let browser = Browser::open();
    let url = format!("file://{}", out.canonicalize().unwrap().display());
    eprintln!(
        "the file has {:.1} MB, loaded in {:.1} s",
        std::fs::metadata(&out).unwrap().len() as f64 / 1e6,
        browser.load(&url)
    );
    pictures_agree(&browser, &f, f.gaussians().sh_degree.min(1));
    // The page's own picking gives the rasteriser's answers.
    clicks_select(&browser, &f, 2);
    for (text, selected, gaussians) in &known {
        browser.ask(text);
        assert_eq!(browser.selected(), *selected, "{text}");
        let Some(gaussians) = gaussians else { continue };
        let saved = read_ply(&browser.saved("save-selection"));
        let drawn = (0..gaussians.len()).filter(|&i| gaussians.opacity(i) >= 1.0 / 255.0).count();
        assert_eq!(saved.len(), drawn, "{text}: all that can be seen");
    }
    let asked = browser.js("return performance.getEntriesByType('resource').map((r) => r.name).filter((n) => !n.startsWith('data:') && !n.startsWith('blob:'))", vec![]);
    assert_eq!(asked, json!([]), "the file asks nobody for anything");
    browser.no_errors();
    Ok(())
}
