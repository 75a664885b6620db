"""A Ray cluster of two machines with one core each, both of them this one."""

import os
from collections.abc import Iterator
from typing import Any

import pytest

RUNNING = "PIPELINE_TEST_CLUSTER"  # HOST:PORT of a cluster to test with in place of a new one
OBJECT_STORE_BYTES = 10**8
WITHOUT_RAY = "Ray is not installed: pip install -c constraints.txt '.[cluster]'"


@pytest.fixture(scope="session")
def ray_cluster() -> Iterator[str]:
    """Its address."""
    pytest.importorskip("ray", reason=WITHOUT_RAY)
    if running := os.environ.get(RUNNING):
        yield running
        return
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    machine: dict[str, Any] = {"num_cpus": 1, "object_store_memory": OBJECT_STORE_BYTES}
    cluster = Cluster(initialize_head=True, head_node_args=machine | {"include_dashboard": False})
    cluster.add_node(**machine)
    yield str(cluster.address)
    cluster.shutdown()
