//! Stage 2b: contextual feature propagation and mask-aware contrastive learning.
