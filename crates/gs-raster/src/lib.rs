//! Differentiable rasteriser of 3D Gaussians on the CPU.
