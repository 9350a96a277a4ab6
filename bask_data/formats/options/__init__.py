"""Options of the readers, a module per format; descriptions are the help of `bask-data ingest <format>`."""
