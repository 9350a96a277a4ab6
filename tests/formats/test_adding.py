"""A format is added in the places listed in the docstring of `bask_data/formats/__init__.py`, and no others."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from bask_data.dataset import Dataset
from bask_data.kinds import Scan
from tests.extended import ExtendedPackage

TOY = '''"""Toy: images from straight above, and a plane below them at a depth that the user states."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from bask_data.formats.options.common import SourceOptions

if TYPE_CHECKING:
    from bask_data.formats.recording import SourceRecording


class ToyOptions(SourceOptions):
    """Images from above."""

    height_above: float = Field(0.5, gt=0, description="Metres from the camera to the plane.")


def read(source: Path, options: ToyOptions) -> SourceRecording:
    """The images in their order."""
    import cv2
    import numpy as np

    from bask_data.formats.recording import SourceCamera, SourceRecording
    from bask_data.core.lens import Lens

    files = tuple(sorted(source.glob("*.png")))
    height, width = cv2.imread(str(files[0])).shape[:2]
    depth = np.full((height, width), round(options.height_above * 1000), np.uint16)
    camera = SourceCamera(
        name="above",
        frames=tuple(file.stem for file in files),
        lens=Lens(np.array([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]]), (height, width)),
        depth_scale=0.001,
        world_from_cameras=np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (len(files), 1, 1)),
        time=np.arange(float(len(files))),
        color=lambda i: cv2.imread(str(files[i]))[..., ::-1].copy(),
        depth=lambda i: depth,
    )
    return SourceRecording((camera,), None, {}, {"depth": f"{options.height_above:g} m everywhere"}, files)
'''


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> ExtendedPackage:
    package = ExtendedPackage(tmp_path_factory.mktemp("extended"), {"formats/toy.py": TOY})
    line = 'Format("toy", "Images from straight above a plane.", ToyOptions),'
    package.add_to_table("formats/__init__.py", line, imports="from bask_data.formats.toy import ToyOptions")
    return package


def test_a_format_that_was_added_is_listed_with_its_options(extended: ExtendedPackage) -> None:
    assert "Images from straight above a plane." in extended.command("ingest", "--help").stdout
    shown = " ".join(extended.command("ingest", "toy", "--help").stdout.split())
    assert "--height-above" in shown and "Metres from the camera to the plane. [default: 0.5]" in shown


def test_a_format_that_was_added_is_ingested(extended: ExtendedPackage, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for i in range(3):
        cv2.imwrite(str(source / f"{i}.png"), np.full((8, 12, 3), 10 * i, np.uint8))
    root = tmp_path / "d"
    made = extended.command("ingest", "toy", source, root, "--scene", "a", "--height-above", "0.75")
    assert made.returncode == 0, made.stderr
    assert "assumed     depth: 0.75 m everywhere" in made.stderr
    dataset = Dataset(root)
    assert dataset.file.scenes["a"].format == "toy"
    [camera] = Scan(dataset.path(Scan, "a")).cameras
    assert (camera.name, camera.n_frames, camera.height, camera.width) == ("above", 3, 8, 12)
    np.testing.assert_allclose(camera.depth(2), 0.75)
    assert camera.rgb(2)[0, 0].tolist() == [20, 20, 20]
    refused = extended.command("ingest", "toy", source, root, "--scene", "b", "--height-above", "-1")
    assert refused.returncode == 2 and "--height-above" in refused.stderr
