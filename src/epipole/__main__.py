"""`python -m epipole`."""

from epipole.cli.main import main

if __name__ == "__main__":
    main()
