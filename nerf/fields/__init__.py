"""Radiance fields: their interface, the vanilla NeRF, the hash grid with its networks, background and occupancy
grid."""
