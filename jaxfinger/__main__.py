"""`python -m jaxfinger`: the command line, whatever is on the path."""

from jaxfinger.cli import main

if __name__ == "__main__":
    main()
