"""Command line as `python -m jaxfinger`, for where the script `jaxfinger` is not on the path."""

from jaxfinger.cli import main

if __name__ == "__main__":
    main()
