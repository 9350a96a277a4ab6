"""Recordings for the Rerun viewer: a dataset's frames, surfaces, objects, masks, matches and keypoints."""
