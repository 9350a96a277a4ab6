"""A small simulated tabletop: recordings with exact ground truth for evaluating the stages."""
