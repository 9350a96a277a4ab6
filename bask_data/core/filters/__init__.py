"""The keypoint filters and their table.

How to add a filter:

1. Write `core/filters/<name>.py`, or a package of that name where one file is not enough, with

    - its settings, a frozen dataclass that extends `table.FilterSettings`; the filter runs with its defaults,
    - its belief, a frozen dataclass of arrays and of tuples of such dataclasses, whose fields may be None: all that the
      next step needs, so that an interrupted track can be resumed from it,
    - its step, `(belief, observations, motion, rng, settings) -> (belief, Estimate)`, a pure function; the belief is
      None before the first frame, an observation is None where a camera gave no frame,
    - its hypotheses, `(belief, observations, settings) -> WeightedPoints | PixelMaps`, for the viewer, and
    - `FILTER = Filter(...)`, which names these and the other attributes of `table.Filter`.

2. Add an entry to `FILTERS` in `core/filters/table.py`: the name, the module, and its text in `encode --help`.

3. A setting is an option of `bask-data encode` if `EncodeParams` in `stages/encode.py` has a field of the same name:
   `alpha`, `tau`, `walk`, `gripper_reach` and others exist, None by default. A setting of another name needs a field of
   its own, None by default and excluded from the dump while it is (`exclude_if=lambda value: value is None`), so that
   the skip keys of existing tracks stay the same.

4. Test it in `tests/core/filters/`. `tests/core/filters/toy.py` is a small example.

`encode`, `KeypointTracker`, `evaluate keypoints`, the report and the viewer use the table and know no filter by name.
"""
