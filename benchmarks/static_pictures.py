"""Pictures of points tracked through a static scene: errors over time, and frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from static_scenes import Points, pixels, runs

from bask_data.kinds import Camera

FAR = 1e4
"""Pixels beyond which OpenCV draws nothing sensible."""


def draw_over_time(file: Path, errors: Mapping[str, np.ndarray], points: Points, reported: np.ndarray) -> None:
    """Errors of some points over time; grey where nothing shows them, dotted their first sight, a bar below the frames
    that are reported."""
    from matplotlib.figure import Figure

    n = min(6, len(points.world))
    figure = Figure(figsize=(11, 1.9 * n), layout="constrained")
    for i, axes in enumerate(np.atleast_1d(figure.subplots(n, 1, sharex=True))):
        for a, b in runs(~points.seen[:, i]):
            axes.axvspan(a - 0.5, b - 0.5, color="0.88")
        for a, b in runs(reported):
            axes.axvspan(a - 0.5, b - 0.5, ymax=0.03, color="0.4")
        axes.axvline(points.seen[:, i].argmax(), color="0.4", linewidth=0.8, linestyle=":")
        for name, error in errors.items():
            axes.plot(np.maximum(error[:, i], 1e-3), label=name, linewidth=1.2)
        axes.set(yscale="log", ylim=(2e-3, 5), ylabel="error, m")
    axes.set_xlabel("frame")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=len(errors), loc="outside upper center", frameon=False)
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=80)


def draw_frames(file: Path, camera: Camera, points: Points, track: np.ndarray) -> None:
    """Six frames: where visible points are (circles) and are taken to be (dots), one colour each, joined by lines."""
    hues = np.arange(len(points.world)) * 180 // len(points.world)
    hsv = np.stack([hues, np.full_like(hues, 230), np.full_like(hues, 255)], axis=1).astype(np.uint8)
    colours = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0].tolist()
    tiles = []
    for i in np.linspace(0, camera.n_frames - 1, 6).astype(int):
        image = camera.rgb(int(i)).copy()
        places = zip(pixels(camera, i, points.world), pixels(camera, i, track[i]), strict=True)
        for j, (true, estimated) in enumerate(places):
            if points.seen[i, j]:
                at = tuple(np.rint(true).astype(int).tolist())
                cv2.circle(image, at, 10, colours[j], 2)
                if np.isfinite(estimated).all() and np.abs(estimated).max() < FAR:
                    to = tuple(np.rint(estimated).astype(int).tolist())
                    cv2.line(image, at, to, colours[j], 1)
                    cv2.circle(image, to, 4, colours[j], -1)
        tiles.append(image)
    sheet = np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:])])
    cv2.imwrite(str(file), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
