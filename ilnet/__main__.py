"""`python -m ilnet`."""

from ilnet.cli import main

main()
