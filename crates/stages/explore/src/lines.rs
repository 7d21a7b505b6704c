//! Messages of JSON-RPC, one a line, on standard input and output. A line that is no message is answered here.

use rmcp::RoleServer;
use rmcp::service::{RxJsonRpcMessage, TxJsonRpcMessage};
use rmcp::transport::Transport;
use serde_json::{Value, json};
use std::future::Future;
use std::io::Result;
use std::sync::Arc;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader, Stdin, Stdout, stdin, stdout};
use tokio::sync::Mutex;
use tokio::task::JoinSet;

/// Longest line that is read, in bytes.
const LONGEST: usize = 4 << 20;
const NO_JSON: i32 = -32700;
const NO_REQUEST: i32 = -32600;
const WRONG_PARAMS: i32 = -32602;

/// Standard input and output as an agent's side.
pub struct Lines {
    from: BufReader<Stdin>,
    /// The line that is being read: whoever waits for it may give up, and come again.
    line: Vec<u8>,
    /// Whether its beginning was too long, and dropped.
    too_long: bool,
    to: Arc<Mutex<Stdout>>,
    /// Answers to what is no message, on their way.
    said: JoinSet<()>,
}

impl Lines {
    /// Of this process.
    pub fn new() -> Self {
        let to = Arc::new(Mutex::new(stdout()));
        Self { from: BufReader::new(stdin()), line: Vec::new(), too_long: false, to, said: JoinSet::new() }
    }

    /// The next line, without its end; none after the last. One that is too long is empty and said to be so.
    async fn next(&mut self) -> Option<std::result::Result<Vec<u8>, ()>> {
        loop {
            let most = (LONGEST + 1 - self.line.len()) as u64;
            let read = (&mut self.from).take(most).read_until(b'\n', &mut self.line).await.ok()?;
            let whole = self.line.ends_with(b"\n");
            if !whole && self.line.len() > LONGEST {
                (self.too_long, self.line) = (true, Vec::new());
            } else if whole || read == 0 {
                let line = std::mem::take(&mut self.line);
                return match std::mem::take(&mut self.too_long) {
                    true => Some(Err(())),
                    false if line.is_empty() => None,
                    false => Some(Ok(line)),
                };
            }
        }
    }
}

async fn write(to: &Mutex<Stdout>, message: &impl serde::Serialize) -> Result<()> {
    let mut line = serde_json::to_vec(message)?;
    line.push(b'\n');
    let mut to = to.lock().await;
    to.write_all(&line).await?;
    to.flush().await
}

impl Transport<RoleServer> for Lines {
    type Error = std::io::Error;

    fn send(&mut self, message: TxJsonRpcMessage<RoleServer>) -> impl Future<Output = Result<()>> + Send + 'static {
        let to = Arc::clone(&self.to);
        async move { write(&to, &message).await }
    }

    async fn receive(&mut self) -> Option<RxJsonRpcMessage<RoleServer>> {
        loop {
            let read = match self.next().await? {
                Ok(line) => message(&line),
                Err(()) => Err(Some(refused(NO_REQUEST, Value::Null, &format!("a line of more than {LONGEST} bytes")))),
            };
            match read {
                Ok(message) => return Some(message),
                Err(None) => {}
                Err(Some(answer)) => {
                    let to = Arc::clone(&self.to);
                    // Who cannot be told has gone.
                    self.said.spawn(async move { _ = write(&to, &answer).await });
                }
            }
        }
    }

    async fn close(&mut self) -> Result<()> {
        while self.said.join_next().await.is_some() {}
        self.to.lock().await.flush().await
    }
}

fn refused(code: i32, id: Value, why: &str) -> Value {
    json!({"jsonrpc": "2.0", "id": id, "error": {"code": code, "message": why}})
}

/// The message that a line holds, or the answer to a line that holds none. Nothing is said to empty lines, and to
/// notifications that nobody knows.
fn message<M: serde::de::DeserializeOwned>(line: &[u8]) -> std::result::Result<M, Option<Value>> {
    let line = line.strip_prefix("\u{feff}".as_bytes()).unwrap_or(line).trim_ascii();
    if line.is_empty() {
        return Err(None);
    }
    let value: Value =
        serde_json::from_slice(line).map_err(|e| Some(refused(NO_JSON, Value::Null, &format!("no JSON: {e}"))))?;
    if let Ok(message) = M::deserialize(&value) {
        return Ok(message);
    }
    let known = value["jsonrpc"] == "2.0" && value["method"].is_string();
    if known && value.get("id").is_none() {
        return Err(None);
    }
    let id = Some(&value["id"]).filter(|id| id.is_string() || id.is_number()).cloned().unwrap_or_default();
    Err(Some(match known && !id.is_null() {
        true => refused(WRONG_PARAMS, id, "the params are not those of this method"),
        false => refused(NO_REQUEST, id, "no request of JSON-RPC 2.0"),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_message_is_answered_with_its_id_where_it_has_one() {
        let answer = |line: &str| message::<RxJsonRpcMessage<RoleServer>>(line.as_bytes());
        for (line, code, id) in [
            ("hello", NO_JSON, json!(null)),
            ("{\"jsonrpc\":\"2.0\",\"id\":1,", NO_JSON, json!(null)),
            ("\u{1b}", NO_JSON, json!(null)),
            ("[]", NO_REQUEST, json!(null)),
            ("17", NO_REQUEST, json!(null)),
            ("{}", NO_REQUEST, json!(null)),
            (r#"{"jsonrpc":"2.0","id":3}"#, NO_REQUEST, json!(3)),
            (r#"{"jsonrpc":"1.0","id":"a","method":"ping"}"#, NO_REQUEST, json!("a")),
            (r#"{"id":4,"method":"tools/list"}"#, NO_REQUEST, json!(4)),
            (r#"{"jsonrpc":"2.0","id":5,"method":7}"#, NO_REQUEST, json!(5)),
            (r#"{"jsonrpc":"2.0","id":null,"method":"ping"}"#, NO_REQUEST, json!(null)),
            (r#"{"jsonrpc":"2.0","id":{},"method":"ping"}"#, NO_REQUEST, json!(null)),
            (r#"{"jsonrpc":"2.0","id":6,"method":"tools/call","params":7}"#, WRONG_PARAMS, json!(6)),
        ] {
            let said = answer(line).unwrap_err().unwrap_or_default();
            assert_eq!((&said["error"]["code"], &said["id"]), (&json!(code), &id), "{line}: {said}");
        }
        for line in ["", "\r\n", r#"{"jsonrpc":"2.0","method":"notifications/x","params":7}"#] {
            assert_eq!(answer(line).unwrap_err(), None, "{line}");
        }
        answer("\u{feff}{\"jsonrpc\":\"2.0\",\"id\":6,\"method\":\"ping\"}\r\n").unwrap();
    }
}
