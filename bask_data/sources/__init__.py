"""Sources of recordings: ingested files and the simulator, published by the engine as stages' artifacts are."""
