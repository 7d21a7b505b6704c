//! Stage 1: optimisation of 3D Gaussians from posed photographs.
