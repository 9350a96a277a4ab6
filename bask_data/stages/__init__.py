"""The stages, one verb a file: open inputs, call the core or the network, write `out`."""
