"""The viewer's widgets: thin panels over the package's functions. Qt and napari are imported only here."""
