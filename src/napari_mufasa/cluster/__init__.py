"""Work beyond one machine: jobs handed to the workers of a `dask.distributed` cluster (docs/clusters.md)."""

from napari_mufasa.cluster.connection import check, connected
from napari_mufasa.cluster.jobs import in_order, unwanted

__all__ = ["check", "connected", "in_order", "unwanted"]
