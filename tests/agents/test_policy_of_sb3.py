"""A policy of Stable-Baselines3's actor, whose layers are stood in for: SB3 need not be installed."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from lunar_mjx.agents.policy import load_policy, policy_of_sb3, save_policy


class Tensor:
    """Numbers as torch gives them."""

    def __init__(self, values):
        self._values = values

    def detach(self):
        return self

    def numpy(self):
        return self._values


def test_the_actors_layers_act_as_they_do_in_torch(tmp_path):
    rng = np.random.default_rng(0)
    weights = [(rng.normal(size=(5, 3)), rng.normal(size=5)), (rng.normal(size=(2, 5)), rng.normal(size=2))]
    layers = [
        SimpleNamespace(weight=Tensor(w), bias=Tensor(b), in_features=w.shape[1], out_features=len(w))
        for w, b in weights
    ]
    relu, tanh = SimpleNamespace(), SimpleNamespace()
    actor = SimpleNamespace(mu=[layers[0], relu, layers[1], tanh])
    model = SimpleNamespace(policy=SimpleNamespace(actor=actor))
    policy = policy_of_sb3(model, {"name": "point", "options": {}}, {"steps": 1})
    obs = rng.normal(size=(4, 3)).astype(np.float32)
    (first, a), (second, b) = weights
    wanted = np.tanh(np.maximum(obs @ first.T + a, 0.0) @ second.T + b)
    again = load_policy(save_policy(policy, tmp_path / "policy.npz"))
    np.testing.assert_allclose(again.act(obs), wanted, atol=1e-5)
