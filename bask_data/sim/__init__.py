"""A small simulated tabletop: recordings of which everything is known, to hold the stages against."""
