//! Stage 2a: anchors, neighbours, nearest anchors and mask footprints.
