import torch

from nerf.kernels.torch import spherical_harmonics, spherical_harmonics_backward


def unit_vectors(count: int) -> torch.Tensor:
    vectors = torch.randn(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return vectors / vectors.norm(dim=-1, keepdim=True)


def test_the_harmonics_are_orthonormal_on_the_sphere() -> None:
    """By Gauss-Legendre quadrature in z and equal angles around it, exact for products of degree 6."""
    z = torch.tensor([-0.9491079123, -0.7415311856, -0.4058451514, 0, 0.4058451514, 0.7415311856, 0.9491079123])
    share = torch.tensor(
        [0.1294849662, 0.2797053915, 0.3818300505, 0.4179591837, 0.3818300505, 0.2797053915, 0.1294849662]
    )
    angle = 2 * torch.pi * torch.arange(8, dtype=torch.float64) / 8
    radius = (1 - z.double() ** 2).sqrt()
    x, y = radius[:, None] * angle.cos(), radius[:, None] * angle.sin()
    directions = torch.stack([x, y, z.double()[:, None].expand_as(x)], -1).reshape(-1, 3)
    values = spherical_harmonics(directions)
    measure = (share.double()[:, None] * (2 * torch.pi / 8)).expand_as(x).reshape(-1)
    products = values.T @ (measure[:, None] * values)
    torch.testing.assert_close(products, torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-6)


def test_the_addition_theorem_holds_in_each_degree() -> None:
    """The squares of one degree l add up to (2l + 1) / 4π in every direction."""
    values = spherical_harmonics(unit_vectors(20)).square()
    for degree in range(4):
        own = values[:, degree**2 : (degree + 1) ** 2].sum(-1)
        torch.testing.assert_close(own, torch.full_like(own, (2 * degree + 1) / (4 * torch.pi)))


def test_the_gradient_is_autograds() -> None:
    directions = unit_vectors(20).requires_grad_()
    grad = torch.randn(20, 16, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    wanted = torch.autograd.grad(spherical_harmonics(directions), directions, grad)[0]
    torch.testing.assert_close(spherical_harmonics_backward(directions.detach(), grad), wanted)
