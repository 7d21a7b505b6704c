//! The door for programs: tools over HTTP and over the Model Context Protocol.

mod common;

use common::{Run, gaussians};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Lines, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

/// An agent's side of `explore mcp`.
struct Agent {
    child: Child,
    to: Option<ChildStdin>,
    from: Lines<BufReader<ChildStdout>>,
    asked: u64,
}

impl Agent {
    fn start(arguments: Vec<String>) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_explore"));
        let command = command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut child = command.spawn().unwrap();
        let (to, from) = (child.stdin.take(), BufReader::new(child.stdout.take().unwrap()).lines());
        let mut agent = Self { child, to, from, asked: 0 };
        let hello = json!({"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "test", "version": "1"}});
        let about = agent.ask("initialize", &hello);
        assert_eq!(about["result"]["serverInfo"]["name"], json!("explore"), "{about}");
        agent.send(&json!({"jsonrpc": "2.0", "method": "notifications/initialized"}));
        agent
    }

    fn send(&mut self, message: &Value) {
        writeln!(self.to.as_mut().unwrap(), "{message}").unwrap();
    }

    /// Every line of standard output must be of the protocol.
    fn ask(&mut self, method: &str, params: &Value) -> Value {
        self.asked += 1;
        let id = self.asked;
        self.send(&json!({"jsonrpc": "2.0", "id": id, "method": method, "params": params}));
        loop {
            let line = self.from.next().expect("the program answers").unwrap();
            let message: Value = serde_json::from_str(&line).unwrap_or_else(|e| panic!("{e}: {line}"));
            if message["id"] == json!(id) {
                return message;
            }
        }
    }

    /// The answer of a tool, or what it says is wrong.
    fn tool(&mut self, name: &str, arguments: &Value) -> Result<Value, String> {
        let answer = self.ask("tools/call", &json!({"name": name, "arguments": arguments}))["result"].take();
        let said: Value = serde_json::from_str(answer["content"][0]["text"].as_str().unwrap()).unwrap();
        assert_eq!(answer["structuredContent"], said, "both forms say the same");
        if answer["isError"] == json!(true) { Err(said["error"].as_str().unwrap().into()) } else { Ok(said) }
    }
}

impl Drop for Agent {
    fn drop(&mut self) {
        drop(self.to.take());
        let ended = self.child.wait().unwrap();
        assert!(ended.success() || std::thread::panicking(), "the program ends with standard input: {ended}");
    }
}

/// Asks both doors, which must answer alike.
struct Doors {
    server: common::Server,
    agent: Agent,
}

impl Doors {
    fn open(run: &Run, more: &[&str]) -> Self {
        let mut arguments = run.arguments("mcp");
        arguments.extend(more.iter().map(|a| (*a).to_string()));
        Self { server: run.serve(more), agent: Agent::start(arguments) }
    }

    fn ask(&mut self, tool: &str, arguments: &Value) -> Result<Value, String> {
        let (status, head, body) = self.server.ask("POST", &format!("/tools/{tool}"), "", &arguments.to_string());
        let said: Value = serde_json::from_slice(&body).unwrap();
        assert!(head.contains("content-type: application/json"), "{head}");
        let by_http = match status {
            200 => Ok(said),
            400 => Err(said["error"].as_str().unwrap().to_string()),
            other => panic!("{tool}: {other}"),
        };
        let by_mcp = self.agent.tool(tool, arguments);
        assert_eq!(by_http, by_mcp, "{tool} {arguments}");
        by_mcp
    }
}

#[test]
fn both_doors_answer_alike() {
    let run = Run::new();
    let edits = json!({"format": "instances.edits", "version": 1,
        "instances": run.instances(),
        "edits": [{"op": "rename", "instance": 0, "name": "Moon"}]});
    std::fs::write(run.out().join("instances.edits.json"), edits.to_string()).unwrap();
    run.write_names(&run.instances());
    let mut doors = Doors::open(&run, &[]);

    let tools = doors.agent.ask("tools/list", &json!({}))["result"]["tools"].take();
    let names: Vec<&str> = tools.as_array().unwrap().iter().map(|t| t["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["list", "find", "measure", "relations", "export"]);
    assert_eq!(tools[1]["inputSchema"]["required"], json!(["text"]));
    let over_http = doors.server.json("GET", "/tools", &Value::Null);
    assert_eq!(over_http["tools"][1]["arguments"], tools[1]["inputSchema"]);

    let list = doors.ask("list", &json!({})).unwrap();
    assert_eq!((list["of"].as_u64(), &list["objects"][0]["name"]), (Some(2), &json!("Moon")));
    let called: Vec<_> = (0..2).map(|k| (&list["objects"][k]["name"], &list["objects"][k]["sure"])).collect();
    assert_eq!(called, [(&json!("Moon"), &json!(true)), (&json!("planet"), &json!(false))], "a person goes first");
    assert_eq!(doors.ask("list", &json!({"most": 1})).unwrap()["objects"][0]["id"], json!(1));

    let ids = |found: &Value| -> Vec<u64> {
        found["found"].as_array().unwrap().iter().map(|f| f["id"].as_u64().unwrap()).collect()
    };
    let found = doors.ask("find", &json!({"text": "far ball"})).unwrap();
    assert_eq!((ids(&found), &found["found"][0]["cosine"]), (vec![1, 0], &json!(1.0)));
    // A name goes before any score, and needs no language model.
    assert_eq!(ids(&doors.ask("find", &json!({"text": "moon", "most": 1})).unwrap()), [0]);
    // A guess is no answer, and a question mark says so.
    assert_eq!(found["found"][0]["named_so"], json!(false));
    assert_eq!(doors.ask("measure", &json!({"object": 1})).unwrap()["object"], json!("planet? (1)"));

    let measured = doors.ask("measure", &json!({"object": 0, "other": 1})).unwrap();
    assert_eq!(measured["gap"], json!({"units": 2.0, "metres": null}));
    let apart = measured["between_centres"]["units"].as_f64().unwrap();
    assert!((apart - 0.45f64.hypot(2.0)).abs() < 1e-3, "{measured}");
    assert!(doors.ask("relations", &json!({})).unwrap()["relations"].is_array());
}

#[test]
fn objects_are_written_where_it_is_allowed_and_nothing_is_overwritten() {
    let run = Run::new();
    let (mine, theirs) = (run.dir.path().join("mine"), run.dir.path().join("theirs"));
    let folder = mine.display().to_string();
    let server = run.serve(&["--exports", &folder]);
    let mut arguments = run.arguments("mcp");
    arguments.extend(["--exports".into(), theirs.display().to_string()]);
    let mut agent = Agent::start(arguments);
    let ask = json!({"objects": [1], "file": "far.ply"});
    let told = server.json("POST", "/tools/export", &ask);
    assert_eq!((&told["gaussians"], &told["of"]), (&json!(2), &json!(4)));
    let read = |path: &std::path::Path| gs_scene::ply::read_gaussians(path).unwrap();
    assert_eq!(read(&mine.join("far.ply")), gaussians().select(&[1, 2]));
    agent.tool("export", &json!({"objects": [1], "others": true, "file": "rest.ply"})).unwrap();
    assert_eq!(read(&theirs.join("rest.ply")), gaussians().select(&[0, 3]));
    let before = std::fs::read(theirs.join("rest.ply")).unwrap();
    let mut refused = |arguments: Value, part: &str| {
        let said = agent.tool("export", &arguments).unwrap_err();
        assert!(said.contains(part), "{arguments}: {said}");
    };
    refused(json!({"objects": [0], "file": "rest.ply"}), "a file of this name is there");
    for name in [
        "../out.ply",
        "/tmp/out.ply",
        "a/b.ply",
        "..",
        "",
        ".ply",
        "a\\b.ply",
        "a\0.ply",
        "-a.ply",
        "a\n.ply",
        "a\u{202e}b.ply",
    ] {
        refused(json!({"objects": [0], "file": name}), "not a name of a file");
    }
    refused(json!({"objects": [0], "file": "a.obj"}), "no format that can be written");
    refused(json!({"objects": [7], "file": "a.ply"}), "no such object; found 7");
    refused(json!({"objects": [], "file": "a.ply"}), "nothing is left to write");
    assert_eq!(std::fs::read(theirs.join("rest.ply")).unwrap(), before);
    assert_eq!(std::fs::read_dir(&theirs).unwrap().count(), 1);
}

#[test]
fn bad_questions_are_answered_with_what_is_wrong() {
    let run = Run::new();
    let mut doors = Doors::open(&run, &[]);
    for (tool, arguments, part) in [
        ("explode", json!({}), "no such tool; found explode, expected list, find"),
        ("find", json!({}), "missing field `text`"),
        ("find", json!({"text": " "}), "not a question"),
        ("find", json!({"text": "zebra"}), "no such text in the table"),
        ("find", json!({"text": "far ball", "most": 0}), "1 to 100"),
        ("measure", json!({"object": -1}), "object: not understood; found an integer -1, expected an integer, 0 to"),
        ("measure", json!({"object": 1u64 << 32}), "found an integer 4294967296, expected an integer, 0 to 4294967295"),
        ("measure", json!({"object": "0"}), "found a string, expected an integer"),
        ("measure", json!({"object": 0.5}), "found a number 0.5, expected an integer"),
        ("measure", json!({"object": [0]}), "found an array, expected an integer"),
        ("measure", json!({"object": 1e30}), "found a number 1e+30, expected an integer"),
        ("find", json!({"text": 7}), "text: not understood; found an integer 7, expected a string"),
        ("find", json!({"text": null}), "found null, expected a string"),
        ("list", json!({"most": true}), "found a boolean, expected an integer, 0 or more"),
        ("export", json!({"objects": 1, "file": "a.ply"}), "found an integer 1, expected an array"),
        ("export", json!({"objects": [{}], "file": "a.ply"}), "objects: not understood; found an object, expected"),
        ("export", json!({"objects": [], "others": "no", "file": "a.ply"}), "found a string, expected a boolean"),
        ("measure", json!({"object": 9}), "object: no such object; found 9"),
        ("measure", json!({"object": 0, "other": 9}), "other: no such object"),
        ("relations", json!({"object": 2}), "no such object"),
        ("relations", json!({"objects": 2}), "unknown field `objects`"),
        ("export", json!({"objects": [0], "file": "a.ply"}), "--exports"),
    ] {
        let said = doors.ask(tool, &arguments).unwrap_err();
        assert!(said.contains(part), "{tool} {arguments}: {said}");
    }
    // JSON's schemas count 1.0 as an integer.
    assert_eq!(doors.ask("list", &json!({"most": 1.0})), doors.ask("list", &json!({"most": 1})));
    assert!(doors.ask("measure", &json!({"object": 0.0, "other": 1e0})).is_ok());
    let (status, _, body) = doors.server.ask("POST", "/tools/measure", "", "[0]");
    let said = String::from_utf8_lossy(&body);
    assert!(status == 400 && said.contains("arguments: not understood; found an array, expected an object"), "{said}");
    let (status, _, body) = doors.server.ask("POST", "/tools/find", "", "{");
    assert!(status == 400 && String::from_utf8_lossy(&body).contains("not understood"));
    assert_eq!(doors.server.ask("POST", "/tools/list", "Origin: http://evil.example\r\n", "").0, 403);
    let mut noisy = Command::new(env!("CARGO_BIN_EXE_explore"));
    let noisy = noisy.args(run.arguments("mcp")).arg("--json").output().unwrap();
    assert!(noisy.status.code() == Some(2) && String::from_utf8_lossy(&noisy.stdout).contains("--json"));
}

fn renamed(instance: u32, name: &str) -> Value {
    json!({"op": "rename", "instance": instance, "name": name})
}

#[test]
fn no_edit_is_lost_between_two_servers_and_an_agent() {
    let run = Run::new();
    let servers = [run.serve(&[]), run.serve(&[])];
    let mut agent = Agent::start(run.arguments("mcp"));
    let [one, other] = &servers;
    let ((_, first), (_, same)) = (one.edits(), other.edits());
    assert_eq!(first, same);
    let (moon, sun) = (renamed(0, "Moon"), renamed(1, "Sun"));
    let (status, second, _) = one.put_edits(&json!([moon]), Some(&first));
    assert!(status == 200 && second != first);
    // What was made of an older list is not kept; the answer says what there is.
    let (status, now, said) = other.put_edits(&json!([sun]), Some(&first));
    assert_eq!((status, &now, &said["edits"]), (409, &second, &json!([moon])));
    assert_eq!((&said["instances"][0]["name"], said["error"].is_string()), (&json!("Moon"), true));
    assert_eq!(other.put_edits(&json!([moon, sun]), Some(&now)).0, 200);
    // Each sees what the others did, and the agent too.
    assert_eq!(one.edits().0, json!([moon, sun]));
    assert_eq!(one.json("GET", "/find?text=sun", &Value::Null)["named"], json!([1]));
    let list = agent.tool("list", &json!({})).unwrap();
    assert_eq!((&list["objects"][0]["name"], &list["objects"][1]["name"]), (&json!("Moon"), &json!("Sun")));
    // Without a version nothing can be taken away.
    assert_eq!(one.put_edits(&json!([sun]), None).0, 409);
    assert_eq!(one.put_edits(&json!([moon, sun, renamed(0, "Luna")]), None).0, 200);

    // Many at once, each for itself, with both.
    std::thread::scope(|s| {
        for k in 0..6 {
            let server = &servers[k % 2];
            s.spawn(move || {
                for round in 0..4 {
                    let own = renamed(1, &format!("{k} {round}"));
                    loop {
                        let (mut edits, version) = server.edits();
                        edits.as_array_mut().unwrap().push(own.clone());
                        match server.put_edits(&edits, Some(&version)).0 {
                            200 => break,
                            status => assert_eq!(status, 409),
                        }
                    }
                }
            });
        }
    });
    let kept = other.edits().0;
    assert_eq!(kept.as_array().unwrap().len(), 3 + 6 * 4);
    for (k, round) in (0..6).flat_map(|k| (0..4).map(move |round| (k, round))) {
        assert!(kept.as_array().unwrap().contains(&renamed(1, &format!("{k} {round}"))), "{k} {round}");
    }
}

#[test]
fn a_run_that_became_another_is_said() {
    let run = Run::new();
    let server = run.serve(&[]);
    let mut agent = Agent::start(run.arguments("mcp"));
    let path = run.out().join("instances.safetensors");
    let bytes = std::fs::read(&path).unwrap();
    let (_, version) = server.edits();
    // Copied over itself it is the same.
    std::fs::write(&path, &bytes).unwrap();
    assert_eq!(server.put_edits(&json!([renamed(0, "Moon")]), Some(&version)).0, 200);
    let edits = run.out().join("instances.edits.json");
    let kept = std::fs::read(&edits).unwrap();

    let (mut instances, artifact) = artifacts::Instances::read(&path).unwrap();
    instances.score[0] = 0.5;
    instances.write(&path, artifact.provenance().clone()).unwrap();
    let refused = |expected: u16, says: &str| {
        for (method, path, body) in [
            ("PUT", "/edits", "[]"),
            ("GET", "/edits", ""),
            ("GET", "/scene.json", ""),
            ("GET", "/find?text=moon", ""),
            ("POST", "/selection", r#"{"cells": [0]}"#),
            ("POST", "/tools/list", ""),
        ] {
            let (status, head, answer) = server.ask(method, path, "", body);
            let answer = String::from_utf8_lossy(&answer);
            assert!(status == expected && answer.contains(says), "{path}: {status} {answer}");
            assert!(!head.contains("etag"), "{head}");
        }
    };
    refused(409, "the run was clustered again");
    assert!(agent.tool("list", &json!({})).unwrap_err().contains("the run was clustered again"));
    assert_eq!(std::fs::read(&edits).unwrap(), kept);
    // Put back it goes on; a list of edits that is about other instances, or damaged, is not written over.
    std::fs::write(&path, &bytes).unwrap();
    assert_eq!(server.edits().0, json!([renamed(0, "Moon")]));
    for other in [r#"{"format": "instances.edits", "version": 1, "instances": "other", "edits": []}"#, "{"] {
        std::fs::write(&edits, other).unwrap();
        refused(409, "instances.edits.json");
        assert_eq!(std::fs::read_to_string(&edits).unwrap(), other);
    }
    std::fs::remove_dir_all(run.out()).unwrap();
    refused(410, "the run is no longer there");
    assert!(agent.tool("list", &json!({})).unwrap_err().contains("no longer there"));
    assert!(!run.out().exists(), "nothing makes it again");
}

#[test]
fn what_is_no_request_is_answered_and_the_agent_is_heard_meanwhile() {
    let run = Run::new();
    let mut agent = Agent::start(run.arguments("mcp"));
    let mut say = |line: &str| {
        writeln!(agent.to.as_mut().unwrap(), "{line}").unwrap();
        serde_json::from_str::<Value>(&agent.from.next().unwrap().unwrap()).unwrap()
    };
    for (line, code, id) in [
        ("hello", -32700, Value::Null),
        ("[1", -32700, Value::Null),
        (r#"{"jsonrpc":"2.0","id":"x","method":5}"#, -32600, json!("x")),
        (r#"{"jsonrpc":"2.0","id":91,"method":"no/such"}"#, -32601, json!(91)),
        (r#"{"jsonrpc":"2.0","id":92,"method":"tools/call","params":{}}"#, -32602, json!(92)),
    ] {
        let said = say(line);
        assert_eq!((&said["error"]["code"], said.get("id")), (&json!(code), Some(&id)), "{line}: {said}");
    }
    // A cancelled question has no answer; the next one has.
    let ask = json!({"jsonrpc": "2.0", "id": 93, "method": "tools/call", "params": {"name": "list", "arguments": {}}});
    let cancel = json!({"jsonrpc": "2.0", "method": "notifications/cancelled", "params": {"requestId": 93}});
    let both = format!("{ask}\n{cancel}\n{}", json!({"jsonrpc": "2.0", "id": 94, "method": "ping"}));
    let said = say(&both);
    // The answer may have been on its way before.
    assert!(said["id"] == json!(94) || said["id"] == json!(93) && agent.from.next().unwrap().unwrap().contains("94"));
}

/// The session of docs/door.md: lines `> tool arguments`, each with the answer below it. CAGS_WRITE_DOOR=1 writes the answers anew.
#[test]
#[ignore = "needs a run of the demo in EXPLORE_RUN: scripts/test_explore.sh"]
fn the_session_in_the_documents_is_true() {
    let run = std::env::var("EXPLORE_RUN").expect("EXPLORE_RUN is the folder of a demo");
    let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../../..");
    let page = format!("{root}/docs/door.md");
    let text = std::fs::read_to_string(&page).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let exports = dir.path().join("exports").display().to_string();
    let clip = format!("{root}/testdata/clip-tiny");
    let arguments = ["mcp", "--run-dir", &run, "--clip", &clip, "--exports", &exports].map(String::from);
    let mut agent = Agent::start(arguments.to_vec());
    let (mut written, mut lines, mut asked) = (String::new(), text.lines(), 0);
    while let Some(line) = lines.next() {
        written += &format!("{line}\n");
        let Some(question) = line.strip_prefix("> ") else { continue };
        let (tool, arguments) = question.split_once(' ').unwrap();
        let told = lines.next().unwrap();
        let arguments: Value = serde_json::from_str(arguments).unwrap();
        let answer = agent.tool(tool, &arguments).unwrap_or_else(|e| json!({"error": e}));
        let answer = answer.to_string().replace(&exports, "exports");
        if std::env::var_os("CAGS_WRITE_DOOR").is_none() {
            let (now, then) = (serde_json::from_str(&answer).unwrap(), serde_json::from_str(told).unwrap());
            assert!(alike(&now, &then), "{question}\nnow   {answer}\ntold  {told}");
        }
        written += &format!("{answer}\n");
        asked += 1;
    }
    assert!(asked >= 6, "{asked} questions");
    if std::env::var_os("CAGS_WRITE_DOOR").is_some() {
        std::fs::write(page, written).unwrap();
    }
}

/// The same but for the last digits: another processor adds up otherwise.
fn alike(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Number(a), Value::Number(b)) => {
            let (a, b) = (a.as_f64().unwrap(), b.as_f64().unwrap());
            (a - b).abs() <= 0.02 * a.abs().max(b.abs()) + 0.005
        }
        (Value::Array(a), Value::Array(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| alike(a, b)),
        (Value::Object(a), Value::Object(b)) => {
            a.len() == b.len() && a.iter().all(|(key, a)| b.get(key).is_some_and(|b| alike(a, b)))
        }
        (a, b) => a == b,
    }
}
