//! Who is let in, and for how long: a client that says little, or much, holds nothing up.

use axum::Router;
use axum::body::{Body, HttpBody, to_bytes};
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto::Builder;
use hyper_util::service::TowerToHyperService;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;

/// What scripts, styles and pictures of the page may come from.
const POLICY: &str = "default-src 'self'; script-src 'self' blob:; worker-src blob:; img-src 'self' data: blob:; \
                      style-src 'self' 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'";
/// Largest body of a request in bytes: ten thousand edits have two megabytes, a hundred that assign 50,000 scattered Gaussians twenty.
const LARGEST_BODY: usize = 32 << 20;
/// Most connections at a time; others wait until one ends.
const MOST: usize = 128;

/// Whom the server waits for, and how long.
#[derive(Debug, Clone, Copy)]
pub struct Rules {
    /// Whether only those who name this machine are answered.
    pub local: bool,
    /// How long the head of a request may take, and then its body. A connection without a request is closed after as long.
    pub patience: Duration,
}

/// Answers for ever.
pub async fn serve(listener: TcpListener, app: Router, rules: Rules) {
    let app = app.layer(middleware::from_fn_with_state(rules, guard));
    let places = Arc::new(Semaphore::new(MOST));
    loop {
        let place = Arc::clone(&places).acquire_owned().await;
        let Ok((stream, _)) = listener.accept().await else {
            // The system has no more files to give, or the client went away.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let app = TowerToHyperService::new(app.clone());
        tokio::spawn(async move {
            let _place = place;
            let mut http = Builder::new(TokioExecutor::new()).http1_only();
            http.http1().timer(TokioTimer::new()).header_read_timeout(rules.patience);
            // Whoever broke off hears no answer.
            let _ = http.serve_connection(TokioIo::new(stream), app).await;
        });
    }
}

/// Lets in who names this server, and no page of another origin; reads all of the request, and adds the policy of the page.
async fn guard(State(rules): State<Rules>, request: Request, next: Next) -> Response {
    let mut response = match refusal(request.headers(), rules.local) {
        Some(why) => (StatusCode::FORBIDDEN, why).into_response(),
        None => match whole(request, rules.patience).await {
            Ok(request) => next.run(request).await,
            Err(refused) => refused.into_response(),
        },
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

const TOO_LARGE: (StatusCode, &str) = (StatusCode::PAYLOAD_TOO_LARGE, "the request is too large, or was cut off");

/// The request with all of its body.
async fn whole(request: Request, patience: Duration) -> Result<Request, (StatusCode, &'static str)> {
    let (parts, body) = request.into_parts();
    if body.size_hint().lower() > LARGEST_BODY as u64 {
        return Err(TOO_LARGE);
    }
    match tokio::time::timeout(patience, to_bytes(body, LARGEST_BODY)).await {
        Ok(Ok(body)) => Ok(Request::from_parts(parts, Body::from(body))),
        Ok(Err(_)) => Err(TOO_LARGE),
        Err(_) => Err((StatusCode::REQUEST_TIMEOUT, "the request took too long")),
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn who_says_little_is_not_waited_for() {
        use tokio::io::{AsyncReadExt, AsyncWriteExt};
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let echo = axum::routing::post(|body: axum::body::Bytes| async move { body.len().to_string() });
        let rules = Rules { local: true, patience: Duration::from_millis(200) };
        tokio::spawn(serve(listener, Router::new().route("/", echo), rules));
        let ask = |text: String| async move {
            let mut stream = tokio::net::TcpStream::connect(address).await.unwrap();
            // The rest is cut off where the server has heard enough.
            let _ = stream.write_all(text.as_bytes()).await;
            let mut answer = Vec::new();
            let _ = stream.read_to_end(&mut answer).await;
            String::from_utf8_lossy(&answer).into_owned()
        };
        let head = |length: usize| format!("POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: {length}\r\n\r\n");
        // Nothing, half a head, and a connection that is kept open: closed.
        assert_eq!(ask(String::new()).await + &ask("POST / HTTP/1.1\r\nHo".into()).await, "");
        assert!(ask(head(2) + "ab").await.ends_with("\r\n\r\n2"));
        assert!(ask(head(9) + "half").await.starts_with("HTTP/1.1 408"));
        assert!(ask(head(LARGEST_BODY + 1)).await.starts_with("HTTP/1.1 413"));
    }

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
