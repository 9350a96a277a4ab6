"""Sources: what brings recordings into a dataset, published by the same engine as what stages make of them."""
