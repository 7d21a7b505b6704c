//! The artifacts that stages exchange: one type, one reader and one writer each.
