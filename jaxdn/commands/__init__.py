"""The commands of the command line, one file each; each is also a function that a script can call."""
