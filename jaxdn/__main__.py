"""``python -m jaxdn``: the command ``jaxdn`` of this Python, where no script of that name is on the path."""

from jaxdn.commands.main import program

program()
