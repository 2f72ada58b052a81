"""rsl-rl's PPO from a dexsim config: the agent's settings, and a policy alone for replay."""

from __future__ import annotations

import contextlib
import copy
import io
import os
from collections.abc import Callable, Iterator
from typing import Any

os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")  # rsl-rl imports GitPython, which fails where git is not installed

import torch
from rsl_rl.utils import resolve_class
from tensordict import TensorDict

from dexsim.errors import UserError
from dexsim.learning import names, teacher

Policy = Callable[[TensorDict], torch.Tensor]  # observations -> actions [N, A]


def agent_config(
    cfg: dict[str, Any], device: str, typed: names.Typed = frozenset(), where: str = "agent settings"
) -> dict[str, Any]:
    """Return the nested dict rsl-rl takes, from ``cfg["agent"]``; its save interval is ours to keep.

    typed: settings that the user typed, which alone may name code of another package. where: whose settings these are.
    Raises UserError for others that do (see :mod:`dexsim.learning.names`).
    """
    agent = copy.deepcopy(cfg["agent"])
    if not isinstance(agent, dict):
        raise UserError(f"{where}: agent is {type(agent).__name__}, must be a group of settings")
    names.check(agent, typed, where)
    names.check_sizes(agent, where)
    if isinstance(agent.get("teacher"), dict):
        agent["teacher"].pop("checkpoint", None)
    agent["seed"], agent["save_interval"] = cfg["seed"], cfg["save_interval"]
    if agent.get("check_for_nan") is None:
        agent["check_for_nan"] = device == "cpu"
    return agent


@contextlib.contextmanager
def agent_errors() -> Iterator[None]:
    """Keep rsl-rl's own printing away and turn its refusals of agent settings into UserError."""
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    except (TypeError, ImportError, AttributeError, KeyError, IndexError, AssertionError, NotImplementedError) as error:
        raise UserError(
            f"agent settings: rsl-rl refuses them: {(str(error) or type(error).__name__).splitlines()[0]}"
        ) from error
    except ValueError as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"agent settings: {str(error).splitlines()[0]}") from error


def scale_first_actions(actor: torch.nn.Module, factor: object) -> None:
    """Multiply the actor's last linear layer by ``factor``, so that a training starts with mean actions near zero.

    With rsl-rl's initial weights a training's first motion, and with it the gait that it finds, depends on the seed.
    A factor of 0.01 is what Andrychowicz et al. (2021, "What Matters for On-Policy Deep Actor-Critic Methods?",
    section 3.2) found best. What a checkpoint holds is loaded over it. Raises UserError unless 0 < factor <= 1.
    """
    if isinstance(factor, bool) or not isinstance(factor, int | float) or not 0 < factor <= 1:
        raise UserError(f"first_actions={factor}: must be a number above 0 and at most 1, e.g. first_actions=0.01")
    if factor == 1:
        return
    last = [m for m in actor.modules() if isinstance(m, torch.nn.Linear)][-1]
    with torch.no_grad():
        last.weight.mul_(factor)
        last.bias.mul_(factor)


def load_policy(data: dict[str, Any], env: Any, path: str, typed: names.Typed = frozenset(), noise: float = 0.0) -> Any:
    """Return the trained actor of a checkpoint, deterministic, for ``env``. Raises UserError where the two do not fit.

    Args:
        data: what :func:`dexsim.learning.checkpoint.load` returned.
        env: the environment rebuilt from its config; gives observation sizes.
        path: the file's name, for messages.
        typed: settings that the user typed (see :func:`agent_config`).
        noise: of the actions, over the noise of training.
    """
    agent = agent_config(data["config"], str(env.device), typed, path)
    with agent_errors():
        acts = teacher.parts(agent)[0]
        kind, settings = resolve_class(agent[acts])
        actor = kind(env.get_observations(), agent["obs_groups"], acts, env.num_actions, **settings).to(env.device)
    weights = data["actor"]
    if hasattr(env, "hand") and env.hand.mirror != bool(data["config"].get("hand_mirror")):
        weights = mirrored(weights, env, path)
    try:
        actor.load_state_dict(weights)
    except (RuntimeError, TypeError, AttributeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: its policy does not fit this environment ({reason})") from None
    actor.eval()
    with torch.no_grad():
        if not bool(actor(env.get_observations()).isfinite().all()):
            raise UserError(
                f"{path}: its policy's actions are not finite in this environment; its weights are out of range, use an"
                " earlier checkpoint of its run folder"
            )
    policy = by_episode(actor, env)
    if not noise:
        return policy
    if (spread := action_noise(data["actor"])) is None:
        raise UserError(f"noise={noise:g}: the policy in {path} has no noise of its own; leave noise= out")
    rng, std = torch.Generator(env.device).manual_seed(env.cfg["seed"]), noise * spread.to(env.device)
    return lambda obs: (a := policy(obs)) + std * torch.randn(a.shape, generator=rng, device=env.device)


def action_noise(actor: dict[str, torch.Tensor]) -> torch.Tensor | None:
    """Return the standard deviation [A] of a trained actor's actions; None where it depends on what it sees."""
    own = {k.rsplit(".", 1)[-1]: v for k, v in actor.items() if k.startswith("distribution.")}
    return own["log_std_param"].exp() if "log_std_param" in own else own.get("std_param")


def mirrored(weights: dict[str, torch.Tensor], env: Any, path: str) -> dict[str, torch.Tensor]:
    """Return the weights of the policy that does with the mirrored hand of `env` what these do with the other one:
    its joints turn as their mirror images do, so that only what is seen changes sign, which the first layer and the
    running mean take up. Raises UserError where the task does not say what changes."""
    signs = env.mirror_signs()
    if signs is None:
        raise UserError(
            f"{path}: trained with the mirror image of this hand, and task {env.task['name']} does not say how its"
            " rows change in a mirror: @observe(mirror=...)"
        )
    out = dict(weights)
    for name, value in weights.items():
        first = name == "mlp.0.weight" and not any("weight_ih_l0" in k for k in weights)
        if (first or "weight_ih_l0" in name or name == "obs_normalizer._mean") and value.shape[-1] == len(signs):
            out[name] = value * signs.to(value.device)
    return out


def by_episode(actor: Any, env: Any) -> Any:
    """Return the actor itself; a recurrent one so that its state begins anew where an episode of ``env`` does."""
    return ByEpisode(actor, env) if actor.is_recurrent else actor


class ByEpisode:
    """A recurrent actor of an environment: observations TensorDict -> actions [N, A]. Its state is zero at the first
    step of each episode, whoever plays it; all else is the actor's."""

    def __init__(self, actor: Any, env: Any):
        self.actor, self._env = actor, env
        actor.reset()

    def __call__(self, obs: TensorDict) -> torch.Tensor:
        state, fresh = self.actor.get_hidden_state(), self._env.episode_length_buf == 0
        if state is not None:
            parts = state if isinstance(state, tuple) else (state,)
            parts = tuple(torch.where(fresh[None, :, None], 0.0, part) for part in parts)
            self.actor.reset(None, parts if isinstance(state, tuple) else parts[0])
        return self.actor(obs)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.actor, name)


def plain_policy(name: str, env: Any, seed: int) -> Policy:
    """Return a policy without learning: ``zero`` (all actions 0), ``random`` (uniform in [-1, 1], what every task's
    actions are clipped to) or ``scripted`` (the task's own, from ``env.scripted_policy()``)."""
    shape = (env.num_envs, env.num_actions)
    if name == "zero":
        return lambda obs: torch.zeros(shape, device=env.device)
    if name == "random":
        generator = torch.Generator(device=env.device).manual_seed(seed)
        return lambda obs: 2 * torch.rand(shape, generator=generator, device=env.device) - 1
    if name == "scripted":
        if not hasattr(env, "scripted_policy"):
            raise UserError("policy=scripted: this task has no scripted policy; use random or zero")
        return env.scripted_policy()
    raise UserError(f"policy={name}: must be random, zero or scripted (a trained one is given as checkpoint=PATH)")
