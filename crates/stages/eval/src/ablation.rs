//! `eval ablation`: the tables of an ablation from the scores of its runs.
//!
//! A [`Plan`] names scenes, seeds, ways of making features and instances, and tables of them; `pipelines/ablation.mk` runs
//! it, one score per cell. Here the cells of each row are brought together: mean and 95% interval over scenes and seeds,
//! the difference from a row of reference cell by cell, and the paper's numbers beside them.

mod interval;
mod page;
mod plan;
mod run;
mod tables;

pub use interval::{Interval, student};
pub use page::sections;
pub use plan::{Expected, Paper, Plan, Row, TablePlan};
pub use run::{Cell, METRICS, Metric, Runs};
pub use tables::{RowResult, Table, fill, markdown, results};
