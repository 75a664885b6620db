"""``python -m tests.numerics`` measures the matrix on the CPU and writes docs/NUMERICS.md."""

from nerf.kernels import torch as reference
from nerf.kernels import warp
from pipeline.doctor.numerics.matrix import matrix
from tests.numerics.document import DOCUMENT, document

if __name__ == "__main__":
    DOCUMENT.write_text(document(matrix({"torch": reference, "warp": warp}, "cpu")), "utf-8")
    print(DOCUMENT)
