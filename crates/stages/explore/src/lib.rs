//! `explore`: a page to look at a scene, click on a thing, ask in words and take it home.
//!
//! `world` loads a run, `pack` brings its Gaussians down to 16 bytes each and
//! `describe` says the rest as JSON. `serve` gives the page of `web/` a server on this machine, whose `answers` come from
//! the rasteriser, for Gaussians within `reach` of a click, and the language model; `page` puts everything into one file that needs no server.
//! `kept` holds what a person changed, and what other programs did meanwhile. `tools` answers programs, over HTTP by `serve` and over the Model Context Protocol by `mcp`, in `lines`.

mod answers;
mod cells;
mod connections;
mod describe;
mod kept;
mod lines;
mod mcp;
mod options;
mod pack;
mod page;
mod pictures;
mod reach;
mod serve;
mod tools;
mod web;
mod world;

pub use options::Args;
