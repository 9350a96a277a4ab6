"""RGB-D scans in; object masks, dense correspondence and Bayesian scene keypoints out."""

__version__ = "0.1.0"
