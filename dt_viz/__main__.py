"""Start the demo: python -m dt_viz, then open the address that it prints."""

from dt_viz.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
