import torch

from nerf.kernels.torch import adam


def test_busy_entries_follow_torchs_adam() -> None:
    generator = torch.Generator().manual_seed(1)
    start = torch.randn(30, 4, generator=generator, dtype=torch.float64)
    given, theirs = start.clone(), start.clone().requires_grad_()
    mean, square = torch.zeros_like(start), torch.zeros_like(start)
    optimiser = torch.optim.Adam([theirs], lr=0.1, betas=(0.9, 0.99), eps=1e-15)
    for count in range(1, 6):
        gradient = torch.randn(30, 4, generator=generator, dtype=torch.float64)
        theirs.grad = gradient.clone()
        optimiser.step()
        adam(given, gradient, mean, square, 0.1, count)
    torch.testing.assert_close(given, theirs.detach())


def test_an_entry_without_gradient_stays_as_it_is_momentum_included() -> None:
    gradient = torch.tensor([1.0, 0.0, 0.0, -2.0])
    parameter, mean, square = torch.ones(4), torch.full((4,), 0.3), torch.full((4,), 0.2)
    adam(parameter, gradient, mean, square, 0.1, 3)
    for tensor, before in ((parameter, 1.0), (mean, 0.3), (square, 0.2)):
        assert torch.equal(tensor[1:3], torch.full((2,), before))
        assert (tensor[[0, 3]] != before).all()


def test_extreme_gradients_move_by_about_the_rate() -> None:
    gradient = torch.tensor([1e-12, 1e-3, 1.0, 1e15, -1e15])
    signs, parameter = gradient.sign(), torch.zeros(5)
    adam(parameter, gradient, torch.zeros(5), torch.zeros(5), 0.1, 1)
    assert not gradient.any(), "it is zero for the next sum"
    torch.testing.assert_close(parameter, -0.1 * signs, rtol=1e-2, atol=0)


def test_a_gradient_whose_square_underflows_hardly_moves_and_stays_finite() -> None:
    parameter = torch.zeros(1)
    adam(parameter, torch.tensor([1e-30]), torch.zeros(1), torch.zeros(1), 0.1, 1)
    assert -0.1 < parameter.item() < 0
