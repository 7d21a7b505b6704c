//! `explore serve`: the page from a server on this machine.
//!
//! Only what is listed here is ever served: the page's own files, the scene, and photographs by number. Whoever asks must
//! name this server (`Host`), and a page of another origin is refused, so that no web page that happens to be open can read
//! the scene. Bound to another address, everything lies below a secret in the URL.

use crate::answers::{self, Click, Export, Lasso};
use crate::connections::{self, Rules};
use crate::describe::Blob;
use crate::kept::{Kept, Lost, Saved};
use crate::options::ServeOptions;
use crate::tools::Asked;
use crate::world::{Edited, World};
use crate::{describe, pictures, tools, web};
use artifacts::Edit;
use axum::Router;
use axum::body::Bytes;
use axum::extract::{DefaultBodyLimit, Path, Query, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use gs_io::{Error, IoContext, Result, Watched};
use gs_scene::dataset::Resolution;
use query::Index;
use rand::TryRng;
use rand::rngs::SysRng;
use serde_json::{Value, json};
use stage::Stage;
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::sync::Semaphore;

/// How long a request may take to come.
const PATIENCE: Duration = Duration::from_secs(20);
/// How long a browser may keep photographs, which do not change while the server runs.
const KEEP: &str = "private, max-age=600";

/// What the handlers share.
struct Shared {
    world: World,
    blob: Blob,
    /// What a person changed.
    kept: Kept,
    /// Turns at what takes much memory: photographs, and Gaussians to save.
    large: Arc<Semaphore>,
    /// Turns at encoding texts, one fewer than cores: the others are for clicks.
    texts: Arc<Semaphore>,
    /// Small photographs, as far as they were asked for.
    previews: Mutex<BTreeMap<usize, Bytes>>,
    /// Folder that programs may write into.
    exports: Option<PathBuf>,
}

impl Shared {
    fn edited(&self) -> Result<Arc<Edited>, Lost> {
        self.kept.now(&self.world)
    }
}

type Held = State<Arc<Shared>>;

/// Serves until the program is interrupted.
pub fn run(o: &ServeOptions, stage: &Stage) -> Result<()> {
    let local = o.bind.is_none();
    let address = SocketAddr::new(o.bind.unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST)), o.port);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let runtime = runtime.map_err(|e| Error::new(format!("cannot start the server: {e}")))?;
    // The port first: loading a scene for nothing takes long.
    let listener = runtime.block_on(tokio::net::TcpListener::bind(address)).map_err(|e| {
        let e = Error::new(format!("cannot listen: {e}")).field(if local { "--port" } else { "--bind, --port" });
        e.found(address).hint("is the page open already? --port 0 takes a free one")
    })?;
    let address = listener.local_addr().at("listen at", "the address")?;
    let shared = Arc::new(shared(o, stage)?);
    // The first text then takes no longer than others.
    runtime.spawn_blocking({
        let shared = Arc::clone(&shared);
        move || shared.world.warm_up()
    });
    let secret = if local { None } else { Some(secret()?) };
    let app = routes(shared);
    let app = match &secret {
        Some(secret) => Router::new().nest(&format!("{secret}/"), app),
        None => app,
    };
    let url = format!("http://{address}{}/", secret.unwrap_or_default());
    stage.info(&format!("look at {url} (Ctrl-C ends)"));
    if o.open
        && let Err(e) = open::that_detached(&url)
    {
        stage.warn(&format!("--open: no browser could be opened ({e}): open {url} yourself"));
    }
    let stopped = async {
        while !stage.interrupted() {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    };
    // Connections that browsers keep open do not hold the end up.
    runtime.block_on(async {
        tokio::select! {
            () = connections::serve(listener, app, Rules { local, patience: PATIENCE }) => {}
            () = stopped => {}
        }
    });
    runtime.shutdown_timeout(Duration::from_secs(1));
    Ok(())
}

/// A path that nobody guesses.
fn secret() -> Result<String> {
    let part = || SysRng.try_next_u64().map_err(|e| Error::new(format!("no random numbers: {e}")));
    Ok(format!("/{:016x}{:016x}", part()?, part()?))
}

fn shared(o: &ServeOptions, stage: &Stage) -> Result<Shared> {
    let run = Watched::by_content([&o.source.instances]);
    let world = World::read(&o.source, Resolution::Auto, stage)?;
    let kept = Kept::new(&world, run)?;
    let blob = describe::blob(&world);
    stage.info(&format!(
        "{} Gaussians, {} instances; the page is {:.1} MB",
        world.packed.order.len(),
        world.scene.instances.len(),
        blob.bytes.len() as f64 / 1e6
    ));
    Ok(Shared {
        world,
        blob,
        kept,
        large: Arc::new(Semaphore::new(pictures::AT_A_TIME)),
        texts: Arc::new(Semaphore::new(rayon::current_num_threads().saturating_sub(1).max(1))),
        previews: Mutex::default(),
        exports: o.exports.clone(),
    })
}

fn routes(shared: Arc<Shared>) -> Router {
    Router::new()
        .route("/", get(|| async { typed("text/html; charset=utf-8", web::INDEX) }))
        .route("/app/{name}", get(app_file))
        .route("/scene.json", get(scene_json))
        .route(
            "/scene.bin",
            get(|State(s): Held| async move { typed("application/octet-stream", s.blob.bytes.clone()) }),
        )
        .route("/photograph/{view}", get(photograph))
        .route("/preview/{view}", get(preview))
        .route("/thumbnail/{instance}", get(thumbnail))
        .route("/pick", post(pick))
        .route("/lasso", post(lasso))
        .route("/find", get(find))
        .route("/edits", get(edits).put(save))
        .route("/selection", post(selection))
        .route("/tools", get(|| async { json(&tools::described()) }))
        .route("/tools/{name}", post(tool))
        // Their bodies were read, up to a limit.
        .layer(DefaultBodyLimit::disable())
        .with_state(shared)
}

fn typed(kind: &'static str, body: impl IntoResponse) -> Response {
    ([(header::CONTENT_TYPE, kind)], body).into_response()
}

/// Why there is no answer, and the status that says so.
struct Failed(StatusCode, Error);

impl From<Error> for Failed {
    fn from(e: Error) -> Self {
        Self(StatusCode::BAD_REQUEST, e)
    }
}

impl From<Lost> for Failed {
    fn from(lost: Lost) -> Self {
        match lost {
            Lost::Gone(e) => Self(StatusCode::GONE, e),
            Lost::Other(e) => Self(StatusCode::CONFLICT, e),
        }
    }
}

impl IntoResponse for Failed {
    fn into_response(self) -> Response {
        (self.0, self.1.to_string()).into_response()
    }
}

/// Does the work on a thread that may be busy for long, and says in words why it failed.
async fn answer<T>(work: impl FnOnce() -> Result<T, Failed> + Send + 'static) -> Response
where
    T: IntoResponse + Send + 'static,
{
    match tokio::task::spawn_blocking(work).await {
        Ok(done) => done.into_response(),
        Err(_) => {
            (StatusCode::INTERNAL_SERVER_ERROR, "the server failed at this; its terminal says why").into_response()
        }
    }
}

/// The same when it is its turn. The work keeps the turn to its end, also where nobody waits for it any more.
async fn in_turn<T>(turns: &Arc<Semaphore>, work: impl FnOnce() -> Result<T, Failed> + Send + 'static) -> Response
where
    T: IntoResponse + Send + 'static,
{
    let turn = Arc::clone(turns).acquire_owned().await;
    answer(move || {
        let _turn = turn;
        work()
    })
    .await
}

/// An answer that was made with these edits.
fn with_edits(edited: &Edited, answer: impl IntoResponse) -> Response {
    let mut response = answer.into_response();
    let tag = HeaderValue::from_str(&format!("\"{}\"", edited.version)).expect("letters and digits");
    response.headers_mut().insert(header::ETAG, tag);
    response
}

fn json(value: &Value) -> Response {
    typed("application/json", value.to_string())
}

fn no_such(what: &str) -> Error {
    Error::new(format!("there is no such {what}"))
}

/// A body of JSON, which is needed no longer.
fn parsed<T: serde::de::DeserializeOwned>(body: Bytes) -> Result<T> {
    serde_json::from_slice(&body).map_err(|e| Error::new(format!("not understood: {e}")))
}

async fn app_file(Path(name): Path<String>) -> Response {
    if name == "style.css" {
        return typed("text/css; charset=utf-8", web::STYLE);
    }
    match web::MODULES.iter().find(|m| m.name == name) {
        Some(module) => typed("text/javascript; charset=utf-8", module.text),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

async fn scene_json(State(s): Held) -> Response {
    answer(move || {
        let all: Vec<usize> = (0..s.world.dataset.views.len()).collect();
        let edited = s.edited()?;
        Ok(with_edits(&edited, json(&describe::scene(&s.world, &edited, &s.blob, "serve", &all))))
    })
    .await
}

async fn photograph(State(s): Held, Path(view): Path<usize>) -> Response {
    in_turn(&Arc::clone(&s.large), move || {
        let view = s.world.dataset.views.get(view).ok_or_else(|| no_such("view"))?;
        let kept = [(header::CONTENT_TYPE, "image/jpeg"), (header::CACHE_CONTROL, KEEP)];
        Ok(pictures::photograph(view).map(|jpeg| (kept, jpeg))?)
    })
    .await
}

/// A small photograph. All of them together are a few megabytes, and each took a large one to decode: they are kept.
async fn preview(State(s): Held, Path(view): Path<usize>) -> Response {
    let kept = move |s: &Shared| s.previews.lock().expect("no panic holds this lock").get(&view).cloned();
    if let Some(jpeg) = kept(&s) {
        return typed("image/jpeg", jpeg);
    }
    in_turn(&Arc::clone(&s.large), move || {
        if let Some(jpeg) = kept(&s) {
            return Ok(typed("image/jpeg", jpeg));
        }
        let photograph = s.world.dataset.views.get(view).ok_or_else(|| no_such("view"))?;
        let jpeg = Bytes::from(pictures::preview(photograph)?);
        s.previews.lock().expect("no panic holds this lock").insert(view, jpeg.clone());
        Ok(typed("image/jpeg", jpeg))
    })
    .await
}

async fn thumbnail(State(s): Held, Path(instance): Path<usize>) -> Response {
    in_turn(&Arc::clone(&s.large), move || {
        let edited = s.edited()?;
        let instances = &edited.instances;
        let best = *pictures::best_views(&s.world, instances).get(instance).ok_or_else(|| no_such("instance"))?;
        let members = Index::new(instances).members(&[instance as u32]);
        let view = &s.world.dataset.views[best.ok_or_else(|| no_such("picture: no view shows it"))?];
        let jpeg = pictures::thumbnail(&view.load_image()?, view, s.world.gaussians(), &members)?;
        Ok(typed("image/jpeg", jpeg))
    })
    .await
}

async fn pick(State(s): Held, body: Bytes) -> Response {
    answer(move || {
        let click: Click = parsed(body)?;
        let edited = s.edited()?;
        Ok(with_edits(&edited, json(&json!(answers::pick(&s.world, &edited, &click)?))))
    })
    .await
}

async fn lasso(State(s): Held, body: Bytes) -> Response {
    in_turn(&Arc::clone(&s.large), move || {
        let lasso: Lasso = parsed(body)?;
        let edited = s.edited()?;
        Ok(with_edits(&edited, json(&json!(answers::lasso(&s.world, &edited, &lasso)?))))
    })
    .await
}

/// `?text=...`.
#[derive(serde::Deserialize)]
struct Words {
    text: String,
}

async fn find(State(s): Held, Query(asked): Query<Words>) -> Response {
    in_turn(&Arc::clone(&s.texts), move || {
        let edited = s.edited()?;
        let found = answers::find(&s.world, &edited, &asked.text)?;
        Ok(with_edits(&edited, json(&json!(found))))
    })
    .await
}

/// The edits, and the instances after them.
fn as_they_are(s: &Shared, edited: &Edited) -> Value {
    json!({
        "edits": edited.edits.edits,
        "instances": describe::instances_of(Some(edited), &s.world),
        "cut": describe::cut(edited, &s.world),
    })
}

async fn edits(State(s): Held) -> Response {
    answer(move || {
        let edited = s.edited()?;
        Ok(with_edits(&edited, json(&as_they_are(&s, &edited))))
    })
    .await
}

/// Keeps the edits in the run's folder, and answers with the instances after them. `If-Match` names the version that they were made
/// from: where there is another now, the answer is 409 with what there is.
async fn save(State(s): Held, headers: HeaderMap, body: Bytes) -> Response {
    let of = headers.get(header::IF_MATCH).map(|v| v.to_str().unwrap_or_default().trim_matches('"').to_string());
    answer(move || {
        let edits: Vec<Edit> = parsed(body)?;
        Ok(match s.kept.replace(&s.world, edits, of.as_deref())?? {
            Saved::Yes(new) => {
                let mut now = as_they_are(&s, &new);
                // Whoever sent them has them.
                now["edits"] = Value::Null;
                with_edits(&new, json(&now))
            }
            Saved::Stale(there) => {
                let mut now = as_they_are(&s, &there);
                now["error"] = "the edits were changed since: make yours again from these".into();
                with_edits(&there, (StatusCode::CONFLICT, json(&now)))
            }
        })
    })
    .await
}

/// A tool's answer; what is wrong with a question is JSON too.
async fn tool(State(s): Held, Path(name): Path<String>, body: Bytes) -> Response {
    let turns = match &name[..] {
        "find" => Some(Arc::clone(&s.texts)),
        "export" => Some(Arc::clone(&s.large)),
        _ => None,
    };
    let ask = move || -> Result<Value, Failed> {
        let arguments = if body.is_empty() { Value::Null } else { parsed(body)? };
        let edited = s.edited()?;
        Ok(tools::ask(&name, arguments, &Asked { world: &s.world, edited: &edited, exports: s.exports.as_deref() })?)
    };
    let work = move || {
        Ok(match ask() {
            Ok(answer) => json(&answer),
            Err(Failed(status, e)) => (status, json(&json!({"error": e.to_string()}))).into_response(),
        })
    };
    match turns {
        Some(turns) => in_turn(&turns, work).await,
        None => answer(work).await,
    }
}

async fn selection(State(s): Held, body: Bytes) -> Response {
    in_turn(&Arc::clone(&s.large), move || {
        let wanted: Export = parsed(body)?;
        let edited = s.edited()?;
        let chosen = answers::selection(&edited.cells, &wanted)?;
        let comments = s.world.scene.geometry.comments(vec!["cags selection".into()]);
        let ply = gs_scene::ply::some_gaussians(s.world.gaussians(), &chosen, &comments)?;
        Ok(with_edits(&edited, typed("application/octet-stream", ply)))
    })
    .await
}
