"""The stores that come with pcdata, in the order that help texts list them."""

from pcdata.io.store import hdf5_store, npz_store, packed_store, pt_store, webdataset_store  # noqa: F401
from pcdata.io.store.store import INFO, STORES, Compression, Store, register_store

__all__ = ["INFO", "STORES", "Compression", "Store", "register_store"]
