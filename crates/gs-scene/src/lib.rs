//! Gaussians, cameras, datasets, images and 3DGS PLY files.
