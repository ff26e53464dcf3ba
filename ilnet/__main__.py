"""`python -m ilnet`."""

from ilnet.commands.cli import main

main()
