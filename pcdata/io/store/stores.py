"""The stores that come with pcdata, in the order that help texts list them."""

from pcdata.io.store.hdf5_store import Hdf5Store
from pcdata.io.store.npz_store import NpzStore
from pcdata.io.store.pt_store import PtStore
from pcdata.io.store.store import INFO, STORES, Compression, Store, register_store

__all__ = ["INFO", "STORES", "Compression", "Hdf5Store", "NpzStore", "PtStore", "Store", "register_store"]
