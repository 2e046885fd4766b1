"""One file a verb of the command line; each is also a function that a script can call."""
