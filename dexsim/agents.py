"""What learns, as objects for `dexsim.train(agent=...)`: fields that an editor completes, for settings of `agent`.

A field that is None stays as the settings have it (`dexsim/configs/agent/`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from os import PathLike
from typing import Any, Literal


@dataclass(frozen=True, kw_only=True)
class PPO:
    """Proximal policy optimization by rsl-rl.

    recurrent: networks with memory, of this kind, as `agent=ppo_lstm`. hidden_dims: layers of actor and critic.
    init_std: of the actions at first. steps: control steps a world contributes to one iteration. The others are
    rsl-rl's own names.
    """

    recurrent: Literal["lstm", "gru"] | None = None
    rnn_hidden_dim: int | None = None
    hidden_dims: tuple[int, ...] | None = None
    init_std: float | None = None
    steps: int | None = None
    learning_rate: float | None = None
    schedule: Literal["adaptive", "fixed"] | None = None
    desired_kl: float | None = None
    num_learning_epochs: int | None = None
    num_mini_batches: int | None = None
    clip_param: float | None = None
    gamma: float | None = None
    lam: float | None = None
    entropy_coef: float | None = None
    value_loss_coef: float | None = None
    max_grad_norm: float | None = None
    symmetric: bool = False
    """Learn from every symmetric situation too, as `agent=ppo_symmetric`."""

    def settings(self) -> list[str]:
        """Return the settings as the command line has them."""
        kind = ["agent=ppo_lstm"] if self.recurrent else ["agent=ppo_symmetric"] if self.symmetric else []
        both = {"rnn_type": self.recurrent, "rnn_hidden_dim": self.rnn_hidden_dim, "hidden_dims": self.hidden_dims}
        nets = {f"{net}.{name}": value for net in ("actor", "critic") for name, value in both.items()}
        return kind + _given(nets, self)


@dataclass(frozen=True, kw_only=True)
class Distillation:
    """A student that learns to act as a teacher that sees more, as `agent=distill`.

    teacher: policy.pt of a run whose actor saw what the critic does (`agent.obs_groups.actor=[critic]`). hidden_dims:
    of the student. steps: control steps a world contributes to one iteration. The others are rsl-rl's own names.
    """

    teacher: str | PathLike[str]
    hidden_dims: tuple[int, ...] | None = None
    init_std: float | None = None
    steps: int | None = None
    learning_rate: float | None = None
    num_learning_epochs: int | None = None
    gradient_length: int | None = None

    def settings(self) -> list[str]:
        """Return the settings as the command line has them."""
        own = {"teacher.checkpoint": f"'{self.teacher}'", "student.hidden_dims": self.hidden_dims}
        return ["agent=distill", *_given(own, self, "student")]


def _given(own: dict[str, Any], agent: PPO | Distillation, acts: str = "actor") -> list[str]:
    """Return settings of `agent` that are not None: `own`, and the fields that are called as rsl-rl calls them."""
    own |= {f"{acts}.distribution_cfg.init_std": agent.init_std, "num_steps_per_env": agent.steps}
    ours = ("recurrent", "rnn_hidden_dim", "hidden_dims", "init_std", "steps", "symmetric", "teacher")
    own |= {f"algorithm.{f.name}": getattr(agent, f.name) for f in fields(agent) if f.name not in ours}
    texts = {k: f"[{','.join(map(str, v))}]" if isinstance(v, (tuple, list)) else v for k, v in own.items()}
    return [f"agent.{k}={v}" for k, v in texts.items() if v is not None]
