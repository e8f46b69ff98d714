"""The stand-in controller on the command line: `python -m jaxfinger.rig.standin`; the code is `simulated.standin`."""

from jaxfinger.rig.simulated.standin import main

if __name__ == "__main__":
    main()
