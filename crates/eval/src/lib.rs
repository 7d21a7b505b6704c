//! Text queries, evaluation protocols and the report.
