#!/usr/bin/env python3
"""Learns the colours of Gaussians with PyTorch through cags.render and its gradient, on a plain CPU.

    pip install torch; examples/torch_splats.py
"""
import cags
import numpy as np
import torch


class Render(torch.autograd.Function):
    """From the tensors of cags.Gaussians (means, log_scales, rotations, opacity_logits, sh) to a picture [height, width, 3]."""

    @staticmethod
    def forward(ctx, camera, *tensors):
        ctx.camera, ctx.gaussians = camera, cags.Gaussians(*(t.detach().numpy() for t in tensors))
        return torch.from_numpy(cags.render(ctx.gaussians, camera).rgb)

    @staticmethod
    def backward(ctx, d_rgb):
        g = cags.render_backward(ctx.gaussians, ctx.camera, d_rgb.numpy())
        return None, *(torch.from_numpy(a) for a in (g.means, g.log_scales, g.rotations, g.opacity_logits, g.sh))


def main():
    random = np.random.default_rng(0)
    means, camera = random.uniform(-1, 1, (200, 3)) + [0, 0, 4], cags.Camera(160, 120, 150, 150, 80, 60)
    arrays = means, np.full((200, 3), -2.0), random.normal(size=(200, 4)), np.full(200, 2.0), random.normal(0, 1, (200, 1, 3))
    target = torch.from_numpy(cags.render(cags.Gaussians(*arrays), camera).rgb)
    *fixed, colors = (torch.tensor(a, dtype=torch.float32) for a in arrays)
    colors = torch.zeros_like(colors, requires_grad=True)
    adam = torch.optim.Adam([colors], lr=0.05)
    for step in range(200):
        loss = (Render.apply(camera, *fixed, colors) - target).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        if step % 50 == 49:
            print(f"step {step + 1}: {-10 * loss.log10().item():.1f} dB")


if __name__ == "__main__":
    main()
