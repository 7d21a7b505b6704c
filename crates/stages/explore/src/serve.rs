//! `explore serve`: the page from a server on this machine.
//!
//! Only what is listed here is ever served: the page's own files, the scene, and photographs by number. Whoever asks must
//! name this server (`Host`), and a page of another origin is refused, so that no web page that happens to be open can read
//! the scene. Bound to another address, everything lies below a secret in the URL.

use crate::answers::{self, Click, Export};
use crate::describe::Blob;
use crate::options::ServeOptions;
use crate::tools::Asked;
use crate::world::{Edited, World};
use crate::{describe, pictures, tools, web};
use artifacts::{Edit, Edits};
use axum::Router;
use axum::body::Bytes;
use axum::extract::{DefaultBodyLimit, Path, Query, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use gs_io::{Error, IoContext, Result};
use gs_scene::dataset::Resolution;
use query::Index;
use rand::TryRngCore;
use rand::rngs::OsRng;
use serde_json::Value;
use stage::Stage;
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// What scripts, styles and pictures of the page may come from.
const POLICY: &str = "default-src 'self'; script-src 'self' blob:; worker-src blob:; img-src 'self' data: blob:; \
                      style-src 'self' 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'";
/// Largest body of a request in bytes.
const LARGEST_BODY: usize = 16 << 20;
/// How long a browser may keep photographs, which do not change while the server runs.
const KEEP: &str = "private, max-age=600";

/// What the handlers share.
struct Shared {
    world: World,
    blob: Blob,
    /// The instances as they are now; nobody holds the lock while he works.
    edited: Mutex<Arc<Edited>>,
    /// Small photographs, as far as they were asked for.
    previews: Mutex<BTreeMap<usize, Bytes>>,
    /// Folder that programs may write into.
    exports: Option<PathBuf>,
    /// Whether only those who name this machine are answered.
    local: bool,
}

impl Shared {
    fn edited(&self) -> Arc<Edited> {
        Arc::clone(&self.edited.lock().expect("no panic holds this lock"))
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
    let shared = Arc::new(shared(o, local, stage)?);
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
            served = axum::serve(listener, app).into_future() => served.at("serve", &url),
            () = stopped => Ok(()),
        }
    })?;
    runtime.shutdown_timeout(Duration::from_secs(1));
    Ok(())
}

/// A path that nobody guesses.
fn secret() -> Result<String> {
    let part = || OsRng.try_next_u64().map_err(|e| Error::new(format!("no random numbers: {e}")));
    Ok(format!("/{:016x}{:016x}", part()?, part()?))
}

fn shared(o: &ServeOptions, local: bool, stage: &Stage) -> Result<Shared> {
    let world = World::read(&o.source, Resolution::Auto, stage)?;
    let edited = world.edited(world.saved_edits()?)?;
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
        edited: Mutex::new(Arc::new(edited)),
        previews: Mutex::default(),
        exports: o.exports.clone(),
        local,
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
        .route("/find", get(find))
        .route("/edits", axum::routing::put(save))
        .route("/selection", post(selection))
        .route("/tools", get(|| async { json(&tools::described()) }))
        .route("/tools/{name}", post(tool))
        .layer(DefaultBodyLimit::max(LARGEST_BODY))
        .layer(middleware::from_fn_with_state(Arc::clone(&shared), guard))
        .with_state(shared)
}

/// Lets in who names this server, and no page of another origin; adds the policy of the page.
async fn guard(State(shared): Held, request: Request, next: Next) -> Response {
    let refused = refusal(request.headers(), shared.local);
    let mut response = match refused {
        Some(why) => (StatusCode::FORBIDDEN, why).into_response(),
        None => next.run(request).await,
    };
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    // Pictures too: a page of another origin may not show them.
    headers.insert("cross-origin-resource-policy", HeaderValue::from_static("same-origin"));
    headers.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers.entry(header::CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    response
}

/// Why a request is refused, if it is.
fn refusal(headers: &HeaderMap, local: bool) -> Option<&'static str> {
    let text = |name: header::HeaderName| headers.get(name).and_then(|v| v.to_str().ok());
    let fetch = |what: &str| headers.get(format!("sec-fetch-{what}")).and_then(|v| v.to_str().ok());
    let host = text(header::HOST).unwrap_or_default();
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
    if local && !["127.0.0.1", "localhost"].contains(&name) {
        return Some("this server answers at 127.0.0.1 only");
    }
    // Browsers name no origin for pictures and scripts. A link from elsewhere to the page is a person's own step.
    let link = fetch("mode") == Some("navigate") && fetch("dest") == Some("document");
    let elsewhere = fetch("site").is_some_and(|site| !["same-origin", "none"].contains(&site)) && !link;
    let stranger = text(header::ORIGIN).is_some_and(|origin| origin != format!("http://{host}"));
    (elsewhere || stranger).then_some("a page of another origin may not ask")
}

fn typed(kind: &'static str, body: impl IntoResponse) -> Response {
    ([(header::CONTENT_TYPE, kind)], body).into_response()
}

/// Does the work on a thread that may be busy for long, and says in words why it failed.
async fn answer<T: IntoResponse + Send + 'static>(work: impl FnOnce() -> Result<T> + Send + 'static) -> Response {
    match tokio::task::spawn_blocking(work).await {
        Ok(Ok(done)) => done.into_response(),
        Ok(Err(e)) => (StatusCode::BAD_REQUEST, e.to_string()).into_response(),
        Err(_) => {
            (StatusCode::INTERNAL_SERVER_ERROR, "the server failed at this; its terminal says why").into_response()
        }
    }
}

fn json(value: &Value) -> Response {
    typed("application/json", value.to_string())
}

fn no_such(what: &str) -> Error {
    Error::new(format!("there is no such {what}"))
}

/// A body of JSON.
fn parsed<T: serde::de::DeserializeOwned>(body: &Bytes) -> Result<T> {
    serde_json::from_slice(body).map_err(|e| Error::new(format!("not understood: {e}")))
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
        let edited = s.edited();
        Ok(json(&describe::scene(&s.world, &edited, &s.blob, "serve", &all)))
    })
    .await
}

async fn photograph(State(s): Held, Path(view): Path<usize>) -> Response {
    answer(move || {
        let view = s.world.dataset.views.get(view).ok_or_else(|| no_such("view"))?;
        let kept = [(header::CONTENT_TYPE, "image/jpeg"), (header::CACHE_CONTROL, KEEP)];
        pictures::photograph(view).map(|jpeg| (kept, jpeg))
    })
    .await
}

/// A small photograph. All of them together are a few megabytes, and each took a large one to decode: they are kept.
async fn preview(State(s): Held, Path(view): Path<usize>) -> Response {
    answer(move || {
        let kept = |s: &Shared| s.previews.lock().expect("no panic holds this lock").get(&view).cloned();
        let made = |s: &Shared| -> Result<Bytes> {
            let photograph = s.world.dataset.views.get(view).ok_or_else(|| no_such("view"))?;
            let jpeg = Bytes::from(pictures::preview(photograph)?);
            s.previews.lock().expect("no panic holds this lock").insert(view, jpeg.clone());
            Ok(jpeg)
        };
        kept(&s).map_or_else(|| made(&s), Ok).map(|jpeg| typed("image/jpeg", jpeg))
    })
    .await
}

async fn thumbnail(State(s): Held, Path(instance): Path<usize>) -> Response {
    answer(move || {
        let (best, members) = {
            let edited = s.edited();
            let instances = &edited.instances;
            let best = *pictures::best_views(&s.world, instances).get(instance).ok_or_else(|| no_such("instance"))?;
            (best, Index::new(instances).members(&[instance as u32]))
        };
        let view = &s.world.dataset.views[best.ok_or_else(|| no_such("picture: no view shows it"))?];
        pictures::thumbnail(&view.load_image()?, view, s.world.gaussians(), &members)
            .map(|jpeg| typed("image/jpeg", jpeg))
    })
    .await
}

async fn pick(State(s): Held, body: Bytes) -> Response {
    answer(move || {
        let click: Click = parsed(&body)?;
        let edited = s.edited();
        Ok(json(&serde_json::json!(answers::pick(&s.world, &edited, &click)?)))
    })
    .await
}

/// `?text=...`.
#[derive(serde::Deserialize)]
struct Words {
    text: String,
}

async fn find(State(s): Held, Query(asked): Query<Words>) -> Response {
    answer(move || {
        let edited = s.edited();
        answers::find(&s.world, &edited, &asked.text).map(|found| json(&serde_json::json!(found)))
    })
    .await
}

/// Keeps the edits in the run's folder, and answers with the instances after them.
async fn save(State(s): Held, body: Bytes) -> Response {
    answer(move || {
        let edits: Vec<Edit> = parsed(&body)?;
        let edits = Edits { instances: s.world.scene.artifact.hash().into(), edits };
        let new = s.world.edited(edits)?;
        new.edits.write(s.world.source.edits())?;
        let list = describe::instances_of(Some(&new), &s.world);
        *s.edited.lock().expect("no panic holds this lock") = Arc::new(new);
        Ok(json(&Value::Array(list)))
    })
    .await
}

/// A tool's answer; what is wrong with a question is JSON too.
async fn tool(State(s): Held, Path(name): Path<String>, body: Bytes) -> Response {
    let ask = move || {
        let arguments = if body.is_empty() { Value::Null } else { parsed(&body)? };
        let edited = s.edited();
        tools::ask(&name, arguments, &Asked { world: &s.world, edited: &edited, exports: s.exports.as_deref() })
    };
    answer(move || {
        Ok(match ask() {
            Ok(answer) => json(&answer),
            Err(e) => (StatusCode::BAD_REQUEST, json(&serde_json::json!({"error": e.to_string()}))).into_response(),
        })
    })
    .await
}

async fn selection(State(s): Held, body: Bytes) -> Response {
    answer(move || {
        let chosen = answers::selection(&s.world, &parsed::<Export>(&body)?)?;
        let comments = s.world.scene.geometry.comments(vec!["cags selection".into()]);
        let ply = gs_scene::ply::some_gaussians(s.world.gaussians(), &chosen, &comments)?;
        Ok(typed("application/octet-stream", ply))
    })
    .await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strangers_are_refused() {
        let of = |pairs: &[(header::HeaderName, &str)], local| {
            let pairs = pairs.iter().map(|(name, value)| (name.clone(), HeaderValue::from_str(value).unwrap()));
            refusal(&pairs.collect(), local).is_some()
        };
        let (host, origin) = (header::HOST, header::ORIGIN);
        assert!(!of(&[(host.clone(), "127.0.0.1:7007")], true) && !of(&[(host.clone(), "localhost:7007")], true));
        // A name that somebody lets lead to this machine.
        assert!(of(&[(host.clone(), "evil.example:7007")], true) && of(&[], true));
        assert!(!of(&[(host.clone(), "192.168.1.2:7007")], false));
        let from = |page: &str| of(&[(host.clone(), "localhost:7007"), (origin.clone(), page)], true);
        assert!(
            !from("http://localhost:7007")
                && from("http://localhost:8000")
                && from("null")
                && from("https://evil.example")
        );
        // A picture within a page of another origin, or of another port here, and a frame; a link to the page is well.
        let fetched = |site: &str, mode: &str, dest: &str| {
            let fetch =
                ["site", "mode", "dest"].map(|n| header::HeaderName::try_from(format!("sec-fetch-{n}")).unwrap());
            let [s, m, d] = fetch;
            of(&[(host.clone(), "localhost:7007"), (s, site), (m, mode), (d, dest)], true)
        };
        assert!(fetched("cross-site", "no-cors", "image") && fetched("same-site", "no-cors", "image"));
        assert!(fetched("cross-site", "navigate", "iframe") && !fetched("cross-site", "navigate", "document"));
        assert!(!fetched("same-origin", "cors", "empty") && !fetched("none", "navigate", "document"));
    }
}
