"""Sets that are joined one by one, for kernels: each member knows another of its set, the root itself."""

from __future__ import annotations

from .jit import device


@device
def root(parent, member):
    """The member that stands for the set; the way to it is made shorter for the next who asks."""
    while parent[member] != member:
        parent[member] = parent[parent[member]]
        member = parent[member]
    return member
