from __future__ import annotations

import json
import shlex

import numpy as np
import pytest

from bask_data.dataset import Dataset, Source
from bask_data.evaluation import keypoint_verdicts as of_keypoints
from bask_data.evaluation import recording_verdicts as of_recording
from bask_data.evaluation import scene_verdicts as of_scene
from bask_data.evaluation.figures import Measured
from bask_data.evaluation.ingest_again import ingest_command
from bask_data.evaluation.judging import verdicts
from bask_data.evaluation.verdicts import ItemVerdict, after_failures, next_step, not_made, stage_verdict
from bask_data.findings import CODES, Finding
from bask_data.formats.verdict import SURE, TRUSTED
from bask_data.kinds import Recognition
from bask_data.kinds.cameras import RecordingMetadata
from bask_data.kinds.correspondences import CorrespondencesMetadata
from bask_data.kinds.masks import MasksMetadata
from bask_data.kinds.objects import InstanceRow, ObjectsMetadata
from bask_data.kinds.reconstruction import Quality, ReconstructionMetadata, UnmeasuredRegion
from bask_data.kinds.reference import Pick
from tests.report.filled import make_views, publish_frames

BOUNDS = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)


KNOWN = "{}% of the depth of a frame, warped into another, meets what was measured there (20 pairs)"
OTHER = (
    "5% of the depth of a frame, warped into another, meets what was measured there; with the other direction of the "
)
OTHER += "poses it would be 86% (33 pairs) [other-reading]"


def recording(agreement: str, registration: str = "depth lies on colour", *, is_scan: bool = True) -> ItemVerdict:
    metadata = RecordingMetadata(format="frames", assumptions={"agreement": agreement, "registration": registration})
    return of_recording.recording_judgement("table", metadata, lambda fix: f"ingest {fix}".strip(), is_scan=is_scan)


def codes(judgement: ItemVerdict) -> list[str]:
    return [finding.code for finding in judgement.findings]


def test_a_sure_reading_passes_with_its_share_as_evidence():
    judgement = recording(f"{KNOWN.format(87)}; {SURE}")
    assert (judgement.verdict, judgement.figure) == ("pass", 0.87)
    assert judgement.evidence.startswith("87 %")


def test_another_reading_fails_and_its_options_are_the_fix():
    options = "--pose-is world_from_camera --axes opencv"
    judgement = recording(f"{OTHER}; pass {options}; {TRUSTED}")
    assert (judgement.verdict, codes(judgement)) == ("fail", ["other-reading"])
    assert judgement.findings[0].fix == f"ingest {options}"
    assert "86%" in judgement.findings[0].evidence and judgement.figure == 0.05


def test_a_reading_without_an_option_is_mended_in_the_source():
    text = f"{KNOWN.format(50)}; the poses are those of the next frame [other-clock]; give each frame the next pose"
    judgement = recording(text)
    assert (judgement.verdict, judgement.findings[0].fix) == ("fail", "correct it in the source, then ingest")


@pytest.mark.parametrize(
    ("text", "code", "verdict"),
    [
        ("9% meet, no more than for a camera at rest [poses-unrelated]", "poses-unrelated", "fail"),
        ("all poses are the same, but depth changes [camera-moved]", "camera-moved", "fail"),
        (
            f"{KNOWN.format(50)}; cannot tell how poses are meant: few pairs [reading-unknown]",
            "reading-unknown",
            "look",
        ),
        ("cannot tell: the camera moves by 1 mm at most [hardly-moves]", "hardly-moves", "pass"),
        ("cannot tell: a single frame has nothing to compare its pose with [few-views]", "few-views", "pass"),
    ],
)
def test_what_depth_says_of_a_recording_is_a_code(text, code, verdict):
    judgement = recording(text)
    assert (judgement.verdict, codes(judgement)) == (verdict, [code])
    assert "[" not in judgement.findings[0].evidence


def test_what_cannot_be_told_of_a_demonstration_needs_no_look_but_what_is_wrong_does():
    text = f"{KNOWN.format(50)}; cannot tell how poses are meant: few pairs [reading-unknown]"
    assert recording(text, is_scan=False).verdict == "pass"
    assert recording(OTHER, is_scan=False).verdict == "fail"


def test_depth_beside_colour_is_told_although_poses_are_right():
    text = "by edges, colour lies 27 pixels away from depth: depth seems not to be registered to colour"
    for stored in (text, f"{text} [depth-shifted]"):  # Earlier versions named no code.
        judgement = recording(f"{KNOWN.format(87)}; {SURE}", stored)
        assert (judgement.verdict, codes(judgement)) == ("look", ["depth-shifted"])
        assert judgement.findings[0].evidence == text


def surface(explained: float, suspect: int = 0, unmeasured: int = 0, warnings: list[str] | None = None) -> ItemVerdict:
    region = UnmeasuredRegion(centre=(0, 0, 0), size=(0.09, 0.07, 0.09), volume=0.0005)
    metadata = ReconstructionMetadata(
        voxel_size=0.004,
        bounds=BOUNDS,
        quality=Quality(frames=40, frames_suspect=suspect, explained=explained, residual_abs=0.003),
        unmeasured=[region] * unmeasured,
        warnings=warnings or [],
    )
    return of_scene.reconstruction_judgement("table", metadata)


@pytest.mark.parametrize(
    ("judgement", "verdict", "found"),
    [
        (surface(0.95), "pass", []),
        (surface(0.7), "look", ["surface-doubtful"]),
        (surface(0.2), "fail", ["surface-unexplained"]),
        (surface(0.95, suspect=1), "pass", ["frame-disagrees"]),
        (surface(0.95, suspect=8), "look", ["frames-disagree"]),
        (surface(0.95, unmeasured=2), "look", ["unmeasured"]),
        (surface(0.95, warnings=["something else is odd"]), "look", ["stage-warning"]),
    ],
)
def test_surfaces_are_judged_by_the_depth_on_them_and_by_what_is_missing(judgement, verdict, found):
    assert (judgement.verdict, codes(judgement)) == (verdict, found)


def objects(n: int, *told: Finding, flags: tuple = (), is_confirmed: bool = False) -> ItemVerdict:
    row = InstanceRow(id=1, n_vertices=9, area_m2=0.01, centroid=(0, 0, 0), extents=(0.1, 0.1, 0.1), flags=list(flags))
    return of_scene.objects_judgement("table", ObjectsMetadata(instances=[row] * n), told, is_confirmed=is_confirmed)


def test_objects_fail_without_any_and_deserve_a_look_when_hollow_unless_labels_confirm_them():
    hollow = Finding(
        "objects-touch", "table", "share of the surface inside the hull: object 1 (66%)", "move them apart"
    )
    assert codes(objects(0, Finding("no-object", "table", "none"))) == ["objects-none"]
    assert (objects(2, hollow).verdict, objects(2, hollow, is_confirmed=True).verdict) == ("look", "pass")
    condition = "if one colour covers several things: "
    assert objects(2, hollow).findings[0].fix == condition + "bask-data objects ROOT --only table --eps 0.01"
    assert objects(2, Finding("object-one-side", "table", "seen from one side")).verdict == "pass"


def test_flagged_objects_are_counted_and_deserve_a_look():
    cut = Finding("object-cut", "table object 1", "cut by the border of what was seen", "a wider view")
    judgement = objects(2, cut, flags=("cut",))
    assert (judgement.verdict, judgement.evidence) == ("look", "2 objects, 2 of them flagged and not trained on")


def masks(pixels: dict[str, int], labels: list[dict] | None = None) -> ItemVerdict:
    return of_scene.masks_judgement("table", MasksMetadata(n_instances=2, pixels=pixels), labels or [])


def label(name: str, iou: float, shared: bool = False) -> dict:
    return {"name": name, "iou": iou, "shared": shared}


CLEAN = {"measured_and_agreeing": 97, "measured_through": 3}


@pytest.mark.parametrize(
    ("judgement", "verdict", "found"),
    [
        (masks(CLEAN), "pass", []),
        (
            masks({"measured_and_agreeing": 57, "measured_behind": 29, "measured_through": 14}),
            "look",
            ["masks-contradicted"],
        ),
        (masks({"measured_and_agreeing": 30, "not_measured_and_kept": 70}), "look", ["masks-unconfirmed"]),
        (masks({"measured_in_front": 30}), "fail", ["masks-empty"]),
        (masks(CLEAN, [label("cup", 0.9), label("box", 0.8)]), "pass", []),
        (masks(CLEAN, [label("cup", 0.6), label("box", 0.6)]), "look", ["masks-off"]),
        (masks(CLEAN, [label("cup", 0.1)]), "fail", ["masks-wrong"]),
    ],
)
def test_masks_are_judged_by_labels_or_else_by_what_depth_says_of_their_pixels(judgement, verdict, found):
    assert (judgement.verdict, codes(judgement)) == (verdict, found)


def test_merged_objects_are_named_and_do_not_lower_the_overlap_of_the_others():
    judgement = masks(CLEAN, [label("bunny", 0.8), label("stems", 0.3, True), label("book", 0.2, True)])
    assert judgement.evidence == "mean IoU 0.80 with 1 labelled object"
    assert [each.evidence for each in judgement.findings] == ["stems and book are one object in the masks"]


def test_things_without_depth_put_what_is_made_from_the_surface_in_doubt():
    assert of_scene.without_depth(masks(CLEAN), 0).verdict == "pass"
    assert of_scene.without_depth(masks(CLEAN), 2).findings[0].evidence.startswith("2 things without depth")


def matches(n: int, n_attempts: int, warnings: list[str]) -> ItemVerdict:
    metadata = CorrespondencesMetadata(n_pairs=9, n_attempts=n_attempts, n_matches=n, rejections={}, warnings=warnings)
    return of_scene.correspondences_judgement("table", metadata)


def test_matches_are_judged_by_the_share_accepted_and_reasons_are_told_in_words():
    hidden = ["object 2 has 18 of 1000 matches; most pixels that are none: hidden_in_b (63% of 164)"]
    edges = ["object 2 has 18 of 1000 matches; most pixels that are none: doubtful_in_b (63% of 164)"]
    assert matches(300, 1000, hidden).verdict == "pass"
    assert (
        matches(300, 1000, edges)
        .findings[0]
        .evidence.endswith("none: at an edge, or seen at a grazing angle (63% of 164)")
    )
    assert codes(matches(20, 1000, [])) == ["few-matches"]
    assert codes(matches(0, 1000, edges)) == ["no-matches"]


@pytest.mark.parametrize(("found", "verdict"), [(0.85, "pass"), (0.5, "look"), (0.2, "fail")])
def test_networks_are_judged_by_the_matches_they_find(found, verdict):
    assert of_keypoints.network_judgement("main", {"validation_pck_4": found}, "held-out frames", 80).verdict == verdict
    assert of_keypoints.evaluation_judgement("main", found, "held-out frames").verdict == verdict


def test_a_network_that_is_best_before_its_training_deserves_a_look():
    assert of_keypoints.network_judgement("main", {"validation_pck_4": 0.9}, "held-out frames", 0).verdict == "look"


def pick(error: float, is_ambiguous: bool = False) -> Pick:
    known = Recognition(error=error, share_found=0.9, n_frames=9, scans=("b",), is_ambiguous=is_ambiguous)
    return Pick(name="lid", recording="a", camera="c", frame=0, u=1, v=1, recognition=known)


def test_keypoints_are_judged_by_the_error_to_expect_and_by_places_that_look_alike():
    assert of_keypoints.reference_judgement("main", [pick(0.008)]).verdict == "pass"
    assert codes(of_keypoints.reference_judgement("main", [pick(0.008), pick(0.009, True)])) == ["keypoints-ambiguous"]
    assert codes(of_keypoints.reference_judgement("main", [pick(0.2)])) == ["keypoints-poor"]


def row(stage: str, *items: ItemVerdict, missing: tuple[str, ...] = ()):
    return stage_verdict(stage, items, missing, "bask-data run ROOT")


GOOD = ItemVerdict("a", "90 %", figure=0.9)
WEAK = ItemVerdict("b", "60 %", figure=0.6, findings=(Finding("masks-off", "b", "it is off", "look"),))
BAD = ItemVerdict("c", "10 %", figure=0.1, findings=(Finding("masks-wrong", "c", "it is wrong", "mend it"),))


def test_a_row_shows_the_worst_item_and_counts_the_others():
    made = row("Visible masks", GOOD, BAD, WEAK, missing=("d",))
    assert (made.verdict, made.worst, made.evidence, made.fix) == ("fail", "c", "10 %", "mend it")
    assert made.others == "worst: c; 1 pass, 1 not made, 1 look, 1 fail"
    assert [finding.code for finding in made.findings] == ["masks-wrong", "masks-off"]


def test_of_items_with_the_same_verdict_the_smallest_figure_is_shown():
    assert row("Visible masks", GOOD, ItemVerdict("z", "80 %", figure=0.8)).worst == "z"


def test_a_stage_is_not_made_until_it_is_made_for_all_items():
    made = row("Visible masks", GOOD, missing=("b", "c", "d", "e"))
    assert (made.verdict, made.evidence, made.fix) == ("not made", "missing: b, c, d and 1 more", "bask-data run ROOT")


def test_what_follows_a_failure_is_no_pass_and_is_mended_by_mending_that():
    rows = after_failures([row("Scans", BAD), row("Surface", GOOD), not_made("Training", "none", "bask-data run ROOT")])
    assert [each.verdict for each in rows] == ["fail", "look", "not made"]
    assert rows[1].why == ("made from what failed: scans",)
    assert rows[2].fix == "mend first: scans"
    step = next_step(rows)
    assert (step.verdict, step.fix) == ("fail", "Mend it")


def test_the_next_step_is_a_failure_before_a_look_before_what_is_not_made():
    missing, weak, good = not_made("Training", "none", "bask-data run ROOT"), row("Objects", WEAK), row("Surface", GOOD)
    assert next_step([good, missing, weak]).why == "Objects: look. It is off."
    assert next_step([good, missing]).fix == "bask-data run ROOT"
    assert next_step([good]).verdict == "pass"


def test_every_code_that_is_judged_is_listed():
    assert {"surface-unexplained", "masks-contradicted", "track-jumps", "objects-none"} <= set(CODES)


def test_the_command_that_reads_a_recording_again_replaces_the_options_that_were_wrong(tmp_path):
    dataset = Dataset.create(tmp_path / "d")
    options = {"trust": True, "pose_is": "camera_from_world", "color": "rgb/*.png", "skip_bad": False}
    dataset.add("scene", "table", Source(format="frames", path="../my scan", options=options))
    words = shlex.split(ingest_command(dataset, "table", "--pose-is world_from_camera"))
    assert words[:5] == ["bask-data", "ingest", "frames", str(tmp_path / "my scan"), str(dataset.root)]
    assert words[5:] == [
        *("--scene", "table", "--color", "rgb/*.png", "--no-skip-bad"),
        *("--pose-is", "world_from_camera", "--force"),
    ]


def test_what_a_file_says_of_options_is_quoted_whatever_it_is(tmp_path):
    dataset = Dataset.create(tmp_path / "d")
    dataset.add("scene", "table", Source(format="frames", path="in"))
    words = shlex.split(ingest_command(dataset, "table", "--pose-is 'x;reboot"))
    assert words[-3:] == ["--pose-is", "'x;reboot", "--force"]


def test_a_refined_recording_is_made_again_by_refine(tmp_path):
    dataset = Dataset.create(tmp_path / "d")
    dataset.add("scene", "table2", Source(format="refine", path="", options={"scan": "table"}))
    applied = {"recording": "demo", "apply": "table"}
    dataset.add("demonstration", "demo2", Source(format="refine", path="", options=applied))
    root = str(dataset.root)
    assert shlex.split(ingest_command(dataset, "table2")) == (
        ["bask-data", "refine", root, "table", "--as", "table2", "--force"]
    )
    assert shlex.split(ingest_command(dataset, "demo2")) == (
        ["bask-data", "refine", root, "demo", "--as", "demo2", "--apply", "table", "--force"]
    )


def test_a_dataset_of_a_scan_says_what_to_make_next_by_commands_of_its_own(tmp_path):
    dataset = Dataset.create(tmp_path / "d")
    assert verdicts(dataset, Measured(dataset)) == []
    publish_frames(dataset, "table", make_views(0.3, 2))
    rows = verdicts(dataset, Measured(dataset))
    assert [each.stage for each in rows] == [
        *("Scans", "Surface", "Objects", "Visible masks", "Matches", "Training", "Demonstrations"),
    ]
    assert next_step(rows).fix == f"bask-data run {dataset.root}"
    json.dumps([each.as_json() for each in rows], allow_nan=False)


def test_tracks_are_judged_by_error_or_spread_and_by_jumps():
    from bask_data.core.scores import distribution

    def track(error: float, spread: float, localised: float, jumps: float) -> ItemVerdict:
        figures = {
            "localised_share": localised,
            "error_m": distribution(np.array([error])),
            "spread_m": distribution(np.array([spread])),
            "n_keypoints": 4,
        }
        return of_keypoints.track_judgement("demo", figures, jumps)

    assert track(0.01, 0.01, 1.0, 0.0).verdict == "pass"
    assert track(np.nan, 0.01, 1.0, 0.0).evidence == "4 keypoints, spread 10 mm (median)"
    assert codes(track(0.3, 0.2, 0.2, 0.1)) == ["track-lost", "track-wrong", "track-uncertain", "track-jumps"]
