"""``python -m thermofuse`` is the command."""

from fusion.cli import main

if __name__ == "__main__":
    main()
