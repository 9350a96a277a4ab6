"""Datasets in Python and in notebooks: `bask_data.open(root)` gives an `OpenDataset`, whose parts are arrays.

import bask_data as bask

ds = bask.open("data/shelf")
ds.scans["table1"][0].rgb
ds.keypoints("demo0").mean
"""
