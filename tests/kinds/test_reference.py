from __future__ import annotations

import numpy as np
import pytest

from bask_data.errors import BadData
from bask_data.kinds import Pick, Recognition, ReferenceKeypoints

PICKS = [
    Pick(
        name="knob",
        recording="a",
        camera="wrist",
        frame=0,
        u=1.0,
        v=2.0,
        recognition=Recognition(error=0.0126, share_found=0.75, n_frames=8, scans=("b", "c"), is_ambiguous=False),
    ),
    Pick(
        name="rim",
        recording="a",
        camera="wrist",
        frame=0,
        u=3.0,
        v=4.0,
        recognition=Recognition(error=0.08, share_found=0.0, n_frames=1, scans=("a",), is_ambiguous=True),
    ),
    Pick(name="handle", recording="d", camera="wrist", frame=0, u=5.0, v=6.0),
]


@pytest.fixture
def kept(tmp_path) -> ReferenceKeypoints:
    ReferenceKeypoints.write(tmp_path / "r", descriptors=np.zeros((3, 4), np.float32), picks=PICKS)
    return ReferenceKeypoints(tmp_path / "r")


def test_what_is_known_of_a_keypoint_is_read_as_it_was_written(kept):
    assert kept.picks == PICKS


def test_the_summary_names_each_expected_error_and_what_is_ambiguous(kept):
    assert kept.summary() == [
        "knob: expected error 13 mm, found within 20 mm in 75% of 8 frames of b, c",
        "rim: expected error 80 mm, found within 20 mm in 0% of 1 frame of a, its own scan: expect more in others; "
        "ambiguous",
        "handle: expected error not measured, as no other frame of a scan shows it; objects move in demonstrations",
        "ambiguous, as several places look the same: rim.  fix: pick others with --pick, or expect a track that jumps "
        "between these places.",
    ]


def test_picks_of_earlier_versions_have_no_expected_error(tmp_path):
    plain = [pick.model_copy(update={"recognition": None}) for pick in PICKS]
    ReferenceKeypoints.write(tmp_path / "r", descriptors=np.zeros((3, 4), np.float32), picks=plain)
    assert [pick.recognition for pick in ReferenceKeypoints(tmp_path / "r").picks] == [None] * 3


@pytest.mark.parametrize(("value", "got"), [(np.nan, "NaN or infinity"), (-1e38, r"1e\+38")])
def test_descriptors_whose_distances_are_no_numbers_are_refused(tmp_path, value, got):
    ReferenceKeypoints.write(tmp_path / "r", descriptors=np.full((3, 4), value, np.float32), picks=PICKS)
    with pytest.raises(BadData, match=f"descriptors: expected .*numbers.*, got {got}"):
        _ = ReferenceKeypoints(tmp_path / "r").descriptors
