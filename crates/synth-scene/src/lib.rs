//! Procedural indoor scenes with exact ground truth.
