"""What is wrong, and how to mend it: with this machine (`machine`), with a recording, with a dataset."""
