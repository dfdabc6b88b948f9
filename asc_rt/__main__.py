"""`python -m asc_rt` is `asc`."""

from asc_rt.cli import main

main()
