//! `explore mcp`: the tools for an agent, over the Model Context Protocol on standard input and output.

use crate::kept::Kept;
use crate::lines::Lines;
use crate::options::McpOptions;
use crate::tools::{self, Asked, TOOLS};
use crate::world::World;
use gs_io::{Error, Result, Watched};
use gs_scene::dataset::Resolution;
use rmcp::model::{
    CallToolRequestParams, CallToolResponse, CallToolResult, CustomRequest, CustomResult, ErrorCode, Implementation,
    ListToolsResult, PaginatedRequestParams, ServerCapabilities, ServerConfig, Tool,
};
use rmcp::service::{RequestContext, RoleServer};
use rmcp::{ErrorData, ServerHandler, serve_server};
use serde_json::{Value, json};
use stage::Stage;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// What an agent is told of all tools.
const ABOUT: &str = "A scene of 3D Gaussians that is divided into objects. Ask list for the objects, find for one that a text \
                     describes, then measure, relations or export with its id.";

struct Shared {
    world: World,
    kept: Kept,
    exports: Option<PathBuf>,
}

/// Answers until standard input ends.
pub fn run(o: &McpOptions, stage: &Stage) -> Result<()> {
    let run = Watched::by_content([&o.source.instances]);
    let world = World::read(&o.source, Resolution::Auto, stage)?;
    let kept = Kept::new(&world, run)?;
    let objects = kept.now(&world)?.objects(&world).objects.len();
    let door = Door(Arc::new(Shared { world, kept, exports: o.exports.clone() }));
    stage.info(&format!("{objects} objects; answers on standard output until standard input ends"));
    // As many questions at a time as there are cores, beside what reads and writes; more wait, where they can be cancelled.
    let busy = rayon::current_num_threads() + 2;
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).max_blocking_threads(busy).enable_all().build();
    let runtime = runtime.map_err(|e| Error::new(format!("cannot start: {e}")))?;
    let warmed = door.clone();
    runtime.spawn_blocking(move || warmed.0.world.warm_up());
    let failed =
        |e: &dyn std::fmt::Display| Error::new(format!("the agent's side failed: {e}")).field("standard input");
    let done = runtime.block_on(async {
        let stopped = async {
            while !stage.interrupted() {
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        };
        let served = async {
            let running = serve_server(door, Lines::new()).await.map_err(|e| failed(&e))?;
            running.waiting().await.map(drop).map_err(|e| failed(&e))
        };
        tokio::select! {
            done = served => done,
            () = stopped => Ok(()),
        }
    });
    // A read of standard input cannot be taken back.
    runtime.shutdown_background();
    done
}

#[derive(Clone)]
struct Door(Arc<Shared>);

impl ServerHandler for Door {
    fn get_info(&self) -> ServerConfig {
        ServerConfig::new(ServerCapabilities::builder().enable_tools().build())
            .with_server_info(Implementation::new("explore", env!("CARGO_PKG_VERSION")))
            .with_instructions(ABOUT)
    }

    async fn list_tools(
        &self,
        _: Option<PaginatedRequestParams>,
        _: RequestContext<RoleServer>,
    ) -> std::result::Result<ListToolsResult, ErrorData> {
        let tools = TOOLS.iter().map(|t| Tool::new(t.name, t.about, (t.schema)())).collect();
        Ok(ListToolsResult::with_all_items(tools))
    }

    /// What is none of the requests that rmcp knows: a method that there is not, or other params than the method's.
    async fn on_custom_request(
        &self,
        request: CustomRequest,
        _: RequestContext<RoleServer>,
    ) -> std::result::Result<CustomResult, ErrorData> {
        Err(match &request.method[..] {
            "initialize" | "ping" | "tools/list" | "tools/call" => {
                ErrorData::invalid_params("the params are not those of this method", None)
            }
            _ => ErrorData::new(ErrorCode::METHOD_NOT_FOUND, "no such method", None),
        })
    }

    async fn call_tool(
        &self,
        request: CallToolRequestParams,
        context: RequestContext<RoleServer>,
    ) -> std::result::Result<CallToolResponse, ErrorData> {
        let shared = Arc::clone(&self.0);
        let work = move || {
            let edited = shared.kept.now(&shared.world)?;
            let asked = Asked { world: &shared.world, edited: &edited, exports: shared.exports.as_deref() };
            tools::ask(&request.name, request.arguments.map_or(Value::Null, Value::Object), &asked)
        };
        let mut working = tokio::task::spawn_blocking(work);
        let answer = tokio::select! {
            answer = &mut working => answer,
            () = context.ct.cancelled() => {
                // What has not begun never does. Nobody hears this answer.
                working.abort();
                return Err(ErrorData::internal_error("cancelled", None));
            }
        };
        let answer = answer.map_err(|_| ErrorData::internal_error("the program failed at this", None))?;
        Ok(match answer {
            Ok(answer) => CallToolResult::structured(answer),
            Err(e) => CallToolResult::structured_error(json!({"error": e.to_string()})),
        }
        .into())
    }
}
