"""``python -m errormotion`` is the command ``errormotion``."""

from errormotion.cli import main

if __name__ == "__main__":
    main()
