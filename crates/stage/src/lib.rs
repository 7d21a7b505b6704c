//! What makes a program a stage: arguments, logging, progress, provenance, exit codes.
