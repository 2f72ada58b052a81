"""What learns, as objects for `dexsim.train(agent=...)`: fields that an editor completes, for settings of `agent`.

A field that is None stays as the settings have it (`dexsim/configs/agent/`).
"""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import Literal


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
        out = ["agent=ppo_lstm"] if self.recurrent else ["agent=ppo_symmetric"] if self.symmetric else []
        both = {
            "rnn_type": self.recurrent, "rnn_hidden_dim": self.rnn_hidden_dim,
            "hidden_dims": None if self.hidden_dims is None else f"[{','.join(map(str, self.hidden_dims))}]",
        }  # fmt: skip
        out += [f"agent.{net}.{k}={v}" for net in ("actor", "critic") for k, v in both.items() if v is not None]
        own = {"agent.actor.distribution_cfg.init_std": self.init_std, "agent.num_steps_per_env": self.steps}
        for name in (
            "learning_rate", "schedule", "desired_kl", "num_learning_epochs", "num_mini_batches", "clip_param", "gamma",
            "lam", "entropy_coef", "value_loss_coef", "max_grad_norm",
        ):  # fmt: skip
            own[f"agent.algorithm.{name}"] = getattr(self, name)
        return out + [f"{k}={v}" for k, v in own.items() if v is not None]


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
        sizes = None if self.hidden_dims is None else f"[{','.join(map(str, self.hidden_dims))}]"
        own = {
            "teacher.checkpoint": f"'{self.teacher}'", "student.hidden_dims": sizes, "num_steps_per_env": self.steps,
            "student.distribution_cfg.init_std": self.init_std, "algorithm.learning_rate": self.learning_rate,
            "algorithm.num_learning_epochs": self.num_learning_epochs,
            "algorithm.gradient_length": self.gradient_length,
        }  # fmt: skip
        return ["agent=distill", *(f"agent.{k}={v}" for k, v in own.items() if v is not None)]
