"""``python -m napari_mufasa``: the command line."""

from napari_mufasa.cli import main

if __name__ == "__main__":
    main()
