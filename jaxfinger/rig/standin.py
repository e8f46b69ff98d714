"""Entry point of `python -m jaxfinger.rig.standin`, the stand-in controller (`simulated.standin`)."""

from jaxfinger.rig.simulated.standin import main

if __name__ == "__main__":
    main()
