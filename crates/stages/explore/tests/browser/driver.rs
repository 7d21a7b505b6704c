//! The few commands of WebDriver (<https://www.w3.org/TR/webdriver2/>) that the tests need.

use crate::common::http;
use serde_json::{Value, json};

/// A browser that a driver on this machine holds; closed when dropped.
pub struct Session {
    host: String,
    path: String,
}

/// The pointer at a place of the window.
pub fn move_to([x, y]: [f64; 2]) -> Value {
    json!({"type": "pointerMove", "duration": 0, "x": x, "y": y})
}

/// The left button pressed.
pub fn down() -> Value {
    json!({"type": "pointerDown", "button": 0})
}

/// The left button let go.
pub fn up() -> Value {
    json!({"type": "pointerUp", "button": 0})
}

impl Session {
    pub fn new(port: &str, capabilities: &Value) -> Self {
        let mut session = Self { host: format!("127.0.0.1:{port}"), path: String::new() };
        let answer = session.command("POST", "/session", &json!({"capabilities": {"alwaysMatch": capabilities}}));
        session.path = format!("/session/{}", answer["sessionId"].as_str().expect("chromium starts"));
        session
    }

    fn command(&self, method: &str, path: &str, body: &Value) -> Value {
        let path = format!("{}{path}", self.path);
        let body = if method == "POST" { body.to_string() } else { String::new() };
        let (status, _, answer) = http(&self.host, method, &path, "Content-Type: application/json\r\n", &body);
        let mut answer: Value = serde_json::from_slice(&answer).unwrap();
        assert_eq!(status, 200, "{method} {path}: {}", answer["value"]["message"]);
        answer["value"].take()
    }

    pub fn goto(&self, url: &str) {
        self.command("POST", "/url", &json!({"url": url}));
    }

    pub fn refresh(&self) {
        self.command("POST", "/refresh", &json!({}));
    }

    pub fn execute(&self, script: &str) {
        self.command("POST", "/execute/sync", &json!({"script": script, "args": []}));
    }

    /// The value that the script gives to the last of its arguments, a function.
    pub fn execute_async(&self, script: &str, args: &[Value]) -> Value {
        self.command("POST", "/execute/async", &json!({"script": script, "args": args}))
    }

    /// What a mouse does, one after the other.
    pub fn mouse(&self, actions: &[Value]) {
        let mouse = json!({"type": "pointer", "id": "mouse", "actions": actions});
        self.command("POST", "/actions", &json!({"actions": [mouse]}));
    }

    pub fn release(&self) {
        self.command("DELETE", "/actions", &Value::Null);
    }

    /// Presses keys where the focus is.
    pub fn press(&self, keys: &str) {
        let one = |key: char| ["keyDown", "keyUp"].map(|action| json!({"type": action, "value": key}));
        let keys = json!({"type": "key", "id": "keys", "actions": keys.chars().flat_map(one).collect::<Vec<_>>()});
        self.command("POST", "/actions", &json!({"actions": [keys]}));
    }

    /// Types with the focus on an element.
    pub fn keys(&self, id: &str, keys: &str) {
        self.command("POST", &format!("{}/value", self.element(id)), &json!({"text": keys}));
    }

    pub fn clear(&self, id: &str) {
        self.command("POST", &format!("{}/clear", self.element(id)), &json!({}));
    }

    fn element(&self, id: &str) -> String {
        let found = self.command("POST", "/element", &json!({"using": "css selector", "value": format!("#{id}")}));
        let name = found.as_object().and_then(|o| o.values().next()).and_then(Value::as_str);
        format!("/element/{}", name.expect("an element"))
    }

    pub fn resize(&self, width: u32, height: u32) {
        self.command("POST", "/window/rect", &json!({"width": width, "height": height}));
    }

    /// A PNG in base64.
    pub fn screenshot(&self) -> Value {
        self.command("GET", "/screenshot", &Value::Null)
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        if !self.path.is_empty() && !std::thread::panicking() {
            self.command("DELETE", "", &Value::Null);
        }
    }
}
