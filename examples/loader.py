"""Load matches with PyTorch, and take a few gradient steps with them on a small descriptor network.

Usage: python examples/loader.py ROOT --out loader.jpg
"""

import argparse
import math
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from torch import nn
from torch.utils.data import DataLoader

import bask_data as bask
from bask_data.nn.loss import infonce
from bask_data.nn.resnet import sampled


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=Path("build/demo/dataset"))
    parser.add_argument("--out", type=Path, default=Path("loader.jpg"))
    arguments = parser.parse_args()

    torch.manual_seed(0)
    pairs = bask.torch.Matches(bask.open(arguments.root), n=64, seed=0)
    print(pairs)
    loader = DataLoader(pairs, batch_size=2, shuffle=True, generator=torch.Generator().manual_seed(0), num_workers=0)
    # 8 numbers for each 8 x 8 pixels. The losses of bask-data take descriptors (b, d, h / 8, w / 8).
    layers = [nn.Conv2d(3, 16, 7, 2, 3), nn.ReLU(), nn.Conv2d(16, 32, 5, 2, 2), nn.ReLU(), nn.Conv2d(32, 8, 5, 2, 2)]
    network = nn.Sequential(*layers)
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    losses = []
    for batch in loader:  # one epoch
        a, b = (network(batch[name].float() / 255 - 0.5) for name in ("rgb_a", "rgb_b"))
        matches_a, matches_b = sampled(a, batch["uv_a"]), sampled(b, batch["uv_b"])
        terms = infonce(a, b, matches_a, matches_b, batch["uv_a"], batch["uv_b"], alpha=16.0, match_weight=0.0)
        optimiser.zero_grad()
        terms.loss.backward()
        optimiser.step()
        losses.append(terms.loss.item())
    print(f"loss {losses[0]:.2f} at the first step, {losses[-1]:.2f} at the last")

    figure, (left, right, curve) = plt.subplots(1, 3, figsize=(10, 2.6), layout="constrained")
    for axes, side in ((left, "a"), (right, "b")):
        axes.imshow(batch[f"rgb_{side}"][0].permute(1, 2, 0).numpy())
        axes.scatter(*batch[f"uv_{side}"][0].numpy().T, c=range(pairs.n), cmap="hsv", s=5)
        axes.set_title(f"rgb_{side}, uv_{side}: {pairs.n} matches")
        axes.axis("off")
    curve.plot(losses)
    n_places = 4 * a.shape[2] * a.shape[3]  # in the other image, half a cell apart
    curve.axhline(math.log(n_places), color="grey", linestyle="--", label="chance level")
    curve.legend()
    curve.set(xlabel="step", ylabel="InfoNCE loss")
    figure.savefig(arguments.out, dpi=80)


if __name__ == "__main__":
    bask.errors.run(main)
