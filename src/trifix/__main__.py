"""`python -m trifix` is `trifix`."""

from trifix.cli import main

if __name__ == "__main__":
    main()
