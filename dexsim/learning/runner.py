"""The training loop: rsl-rl's PPO and writer in a loop of our own.

rsl-rl's ``OnPolicyRunner`` builds the algorithm. Its ``learn``, ``save`` and console are replaced, because they repeat
an iteration after a resume, stall the GPU at each step for their statistics, and save neither config nor random state.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dexsim.learning import checkpoint, names, teacher, weights_and_biases
from dexsim.learning.meter import Meter
from dexsim.learning.ppo import agent_config, agent_errors, by_episode, load_policy, scale_first_actions
from dexsim.learning.ranks import Ranks, seed_all
from dexsim.tasks import worlds

import torch  # isort: skip  (ppo sets what rsl-rl needs before it is imported)
from rsl_rl.runners import OnPolicyRunner  # isort: skip
from rsl_rl.utils import check_nan  # isort: skip
from dexsim.learning import graphed  # isort: skip
from dexsim.learning.rollout import Rollout  # isort: skip

from dexsim.errors import UserError

SMALL = 64 << 20
"""Bytes that all worlds' states may take in a checkpoint where ``save_worlds`` does not say."""


class Runner(OnPolicyRunner):
    """PPO on a dexsim environment.

    Args:
        env: an rsl-rl ``VecEnv`` with ``describe``, ``check``, ``state_dict``, ``load_state_dict``, ``action_names``;
        for a resume that is the unbroken run, also ``keep_worlds``, ``load_worlds`` (see :mod:`dexsim.tasks.worlds`);
        where it changes with the share of a training that is over, ``trained``.
        cfg: the resolved config, kept in every checkpoint.
        versions: what :func:`dexsim.cli.machine.versions` says, kept in every checkpoint.
        ranks: the processes that learn together, already joined; one alone where not given.
        typed: settings that the user typed, which alone may name code of another package
        (:mod:`dexsim.learning.names`).

    ``iteration`` and ``steps`` count what was learned so far, a resumed run's past included; steps are those of all
    ranks.
    """

    def __init__(
        self, env: Any, cfg: dict[str, Any], versions: dict[str, str], ranks: Ranks | None = None,
        typed: names.Typed = frozenset(),
    ) -> None:  # fmt: skip
        self.ranks = ranks or Ranks({})
        self.full_cfg, self._versions, self._git = cfg, versions, checkpoint.git_state()
        device = str(env.device)
        # Networks of noisy gradients do not need the last bits of a product; the update takes a quarter less time
        # (H200).
        torch.backends.cuda.matmul.allow_tf32 = bool(cfg.get("tf32", True))
        taught = teacher.fill(cfg)
        with agent_errors():
            super().__init__(env, agent_config(cfg, device, typed), log_dir=None, device=device)
        if taught is not None:
            teacher.give(self.alg, taught)
        # what acts and what helps it to learn; in a checkpoint "actor" and "critic"
        self._parts = [getattr(self.alg, f"_raw_{part}") for part in teacher.parts(cfg["agent"])]
        scale_first_actions(self.alg.get_policy(), cfg.get("first_actions", 1.0))
        self.iteration, self.steps = 0, 0
        self._averaged, self._typed = int(cfg.get("average") or 0), typed
        self._average = {name: value.clone() for name, value in self._parts[0].state_dict().items()}
        # Recorded on CUDA only: on a CPU there is nothing to gain, and rsl-rl's own is the reference.
        record = device.startswith("cuda") and cfg.get("graphed_update", True) and not graphed.unsupported(self.alg)
        self._updater = graphed.GraphedUpdate(self.alg) if record else self.alg
        self._rollout = Rollout(self.alg) if record else None
        if device.startswith("cuda"):
            graphed.sample_without_waiting(self.alg.get_policy())
        self._meter = Meter(env.num_envs, device)
        self._layout = checkpoint.layout_of(env)
        self._fresh = True
        self.saves_worlds = self._whether_worlds(cfg.get("save_worlds"))
        self.resumed = ""  # what became of the worlds at `restore`, in words

    def _configure_multi_gpu(self) -> None:
        """Tell rsl-rl about the other ranks. Its own version also starts the group, for GPUs only; ours runs
        already."""
        ranks = self.ranks
        self.gpu_world_size, self.gpu_global_rank, self.gpu_local_rank = ranks.size, ranks.rank, ranks.local
        self.is_distributed = ranks.size > 1
        several = {"global_rank": ranks.rank, "local_rank": ranks.local, "world_size": ranks.size}
        self.cfg["multi_gpu"] = several if self.is_distributed else None

    def _whether_worlds(self, wanted: bool | None) -> bool:
        """Return whether checkpoints hold the worlds' states: as asked, else where they are small."""
        able = hasattr(self.env, "keep_worlds")
        if wanted and self.ranks.size > 1:
            raise UserError("save_worlds=true: works with one process, not under torchrun; leave it out")
        if wanted and not able:
            raise UserError("save_worlds=true: this task's environment has no keep_worlds(); leave it out")
        if wanted is not None or not able or self.ranks.size > 1:
            return bool(wanted)
        return sum(w.numel() * w.element_size() for w in self.env.keep_worlds().values()) <= SMALL

    def open_writer(self, folder: Path) -> Any:
        """Open rsl-rl's writer (``agent.logger``: TensorBoard unless told otherwise) on the run folder."""
        known = self._git["commit"] != "unknown"
        self.logger.log_dir, self.logger.git_status_repos = str(folder), [__file__] if known else []
        with agent_errors():  # rsl-rl writes git/<repository>.diff as well
            if self.cfg.get("logger") == "wandb":
                weights_and_biases.open_writer(
                    self.logger, folder, self.cfg.get("wandb_project") or "dexsim", self.full_cfg
                )
            else:
                self.logger.init_logging_writer()
        if not known:
            (folder / "git").rmdir()
        return self.logger.writer

    def learn(
        self,
        iterations: int,
        on_iteration: Callable[[dict[str, float]], None] = lambda row: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Learn until ``iterations`` are done in all; False when ``stop()`` ended it early.

        ``on_iteration`` gets the iteration's scalars, over all ranks. A rollout that ``stop`` breaks off is dropped, an
        update never; several ranks agree on it before the next rollout, so that none waits for another that has left.
        Raises UserError when learning diverges or the environment's ``check()`` finds something lost.
        """
        if self._fresh and self.cfg.get("init_at_random_ep_len"):
            self.env.episode_length_buf = torch.randint_like(
                self.env.episode_length_buf, high=max(int(self.env.max_episode_length), 1)
            )
        self._fresh = False
        self.alg.train_mode()
        if self.is_distributed:  # each rank drew its own initial weights
            self.alg.broadcast_parameters()
        # The environment may hand out the same buffers at every step; PPO stores them only after the next one.
        obs = self.env.get_observations().clone()
        trained = getattr(self.env, "trained", lambda share: None)
        while self.iteration < iterations:
            trained(self.iteration / iterations)
            if self.is_distributed and self.ranks.any(stop()):
                return False
            start = time.perf_counter()
            before = self._moment() if self.saves_worlds else None
            with torch.no_grad():  # not inference_mode: what the environment keeps from here is changed in place later
                for _ in range(self.cfg["num_steps_per_env"]):
                    if not self.is_distributed and stop():
                        self.alg.storage.clear()
                        self._meter.drop()
                        if before is not None:
                            self._go_back(before)
                        return False
                    obs = self._step(obs)
                (self._rollout or self.alg).compute_returns(obs)
            self.env.check()
            collected = time.perf_counter()
            losses = self._update()
            self.iteration += 1
            self.current_learning_iteration = self.iteration
            if self._averaged:
                self._follow()
            self.steps += self.steps_per_iteration
            row = self._meter.read(self.ranks.sum)
            row |= {f"Loss/{k}": float(v) for k, v in losses.items()}
            row |= {
                "Loss/learning_rate": self.alg.learning_rate,
                "Policy/mean_std": self.alg.get_policy().output_std.mean().item(),
            }
            row |= {"collect_s": collected - start, "learn_s": time.perf_counter() - collected}
            on_iteration({"iteration": self.iteration, "steps": self.steps} | row)
        return True

    def _moment(self) -> dict[str, Any]:
        """Return all that a rollout changes, copied: what was saved in the middle of one that was broken off would
        not be the run that did not stop."""
        return {
            "env": self.env.state_dict(),
            "worlds": self._worlds(),
            "rng": checkpoint.rng_state(),
            "buffers": [b.clone() for b in self._buffers()],
        }

    def _go_back(self, moment: dict[str, Any]) -> None:
        """Return to the moment before a rollout."""
        self.env.load_state_dict(moment["env"])
        self._load_worlds(moment["worlds"])
        checkpoint.set_rng_state(moment["rng"])
        for buffer, value in zip(self._buffers(), moment["buffers"], strict=True):
            buffer.copy_(value)

    def _buffers(self) -> list[torch.Tensor]:
        """Return what the networks keep beside weights: the observations' running normalization."""
        return [b for part in self._parts for b in part.buffers()]

    def _worlds(self) -> dict[str, torch.Tensor]:
        return self.env.keep_worlds() | self._meter.state()

    def _load_worlds(self, worlds: dict[str, torch.Tensor]) -> None:
        self._meter.load({k: v for k, v in worlds.items() if k.startswith("meter.")})
        self.env.load_worlds({k: v for k, v in worlds.items() if not k.startswith("meter.")})

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps that all ranks together contribute to one iteration."""
        return self.cfg["num_steps_per_env"] * self.env.num_envs * self.ranks.size

    def _step(self, obs: Any) -> Any:
        actions = (self._rollout or self.alg).act(obs)
        obs, rewards, dones, extras = self.env.step(actions)
        if self.cfg["check_for_nan"]:
            try:
                check_nan(obs, rewards, dones)
            except ValueError as error:  # of an environment that does not see to it itself, as HandEnv does
                raise UserError(f"iteration {self.iteration + 1}: {str(error).splitlines()[0]}") from None
        if self._rollout is not None:
            self._rollout.store(rewards, dones, extras.get("time_outs"))
        else:
            obs = obs.clone()
            self.alg.process_env_step(obs, rewards, dones, extras)
        self._meter.add(rewards, dones, extras.get("log"))
        return obs

    def _update(self) -> dict[str, float]:
        """Return one PPO update. Raises UserError when it left something not finite, before that is saved."""
        try:
            losses = self._updater.update()
        except RuntimeError:
            if self._finite():
                raise
            losses = {}  # a later mini-batch stumbled over the weights
        bad = [f"{k} loss {v}" for k, v in losses.items() if not math.isfinite(v)]
        if not bad and not self._finite():
            bad = [f"{self._first_not_finite()}: weights not finite"]
        if bad:
            raise UserError(
                f"learning diverged at iteration {self.iteration + 1} ({', '.join(bad)}); continue from the"
                " last checkpoint with a lower agent.algorithm.learning_rate or desired_kl"
            )
        return losses

    def _follow(self) -> None:
        """Let the averaged policy follow the one that learns (``average``): equal weights at first, then exponential.
        Averages of an optimizer's path are better and vary less than its last point (Polyak and Juditsky, 1992)."""
        share = 1.0 / min(self.iteration, self._averaged)
        for name, value in self._parts[0].state_dict().items():
            if value.is_floating_point():
                self._average[name].lerp_(value, share)
            else:
                self._average[name].copy_(value)

    def _finite(self) -> bool:
        """Return whether the weights and the observations' running normalization are finite."""
        weights = [p for group in self.alg.optimizer.param_groups for p in group["params"]]
        weights += [b for b in self._buffers() if b.is_floating_point()]
        return bool(torch.stack(torch._foreach_norm(weights, math.inf)).isfinite().all())  # two launches

    def _first_not_finite(self) -> str:
        """Name of the first weights that are not finite."""
        named = zip(teacher.parts(self.cfg), self._parts, strict=True)
        weights = ((f"{kind}.{name}", w) for kind, part in named for name, w in part.state_dict().items())
        return next((name for name, w in weights if not bool(w.isfinite().all())), "the optimizer's")

    def _config(self) -> dict[str, Any]:
        """Return the config as a checkpoint keeps it: playing or resuming it logs to nobody's account unless asked
        again."""
        agent = self.full_cfg["agent"]
        here = agent | {"logger": "tensorboard"} if agent.get("logger") == "wandb" else agent
        return self.full_cfg | {"agent": here}

    def payload(self) -> dict[str, Any]:
        """Return everything that a checkpoint holds (see :mod:`dexsim.learning.checkpoint`)."""
        actor, critic = (part.state_dict() for part in self._parts)
        data = {
            "kind": "train", "config": self._config(), "versions": self._versions, "git": self._git,
            "layout": self._layout, "iteration": self.iteration, "steps": self.steps, "actor": actor, "critic": critic,
            "optimizer": self.alg.optimizer.state_dict(), "env": self.env.state_dict(), "rng": checkpoint.rng_state(),
        }  # fmt: skip
        if self._averaged:  # what is played is the average, what learns on is "learner"
            data |= {"actor": dict(self._average), "learner": actor}
        return data | ({"worlds": self._worlds()} if self.saves_worlds else {})

    def restore(self, data: dict[str, Any], path: str) -> None:
        """Go on from a checkpoint: networks, optimizer, learning rate, counters, environment, random state, and the
        worlds where it holds them and the settings that make them are the same (``resumed`` says so). The random state
        is rank 0's; the others begin streams of their own.

        Raises UserError when it holds only a policy or does not fit this environment.
        """
        if data["kind"] != "train":
            raise UserError(f"{path}: holds only a policy, nothing to resume; use the last.pt of its run folder")
        checkpoint.check_layout(data, self._layout, path)
        try:
            kinds = zip(teacher.parts(self.cfg), (data.get("learner", data["actor"]), data["critic"]), strict=True)
            states = {f"{kind}_state_dict": state for kind, state in kinds}
            self.alg.load(states | {"optimizer_state_dict": data["optimizer"]}, None, True)
        except Exception as error:  # torch's optimizers meet a wrong state with any of Python's exceptions
            reason = " ".join(str(error).split())[:200]
            raise UserError(f"{path}: does not fit the networks of this run ({reason})") from None
        self._average = {name: value.to(self.device).clone() for name, value in data["actor"].items()}
        self.iteration, self.steps = int(data["iteration"]), int(data["steps"])
        try:
            self.env.load_state_dict(data["env"])
            self._resume_worlds(data)
            checkpoint.set_rng_state(data["rng"])
        except Exception as error:
            reason = " ".join(str(error).split())[:200]
            raise UserError(
                f"{path}: damaged checkpoint, its env, worlds or rng does not fit ({type(error).__name__}: {reason});"
                " use another checkpoint of its run folder"
            ) from None
        if self.ranks.rank:
            seed = self.ranks.seed(self.full_cfg["seed"], self.iteration)
            seed_all(seed)
            self.env.rng.manual_seed(seed)
            self.env.reset_all()
        # An environment whose state does not hold its episodes began them all anew just now; their ages are then spread
        # as at the first start, or all worlds would time out, and dip in the curves, together.
        if not self._resumed_worlds:
            self._fresh = not bool(self.env.episode_length_buf.any())

    def _resume_worlds(self, data: dict[str, Any]) -> None:
        """Take over the worlds of a checkpoint, if they can be this run's."""
        self._resumed_worlds = False
        other = worlds.changed(data["config"], self.full_cfg)
        if self.ranks.size > 1 or not hasattr(self.env, "load_worlds"):
            why = "of several ranks" if self.ranks.size > 1 else ""
        elif "worlds" not in data:
            why = "the checkpoint does not hold them: save_worlds=true keeps them"
        elif other:
            why = f"{other} differs from the checkpoint's"
        elif worlds.of_another_version(self.env, {k: v for k, v in data["worlds"].items() if k[:6] != "meter."}):
            why = "the checkpoint's are of another dexsim"
        else:
            self._load_worlds(data["worlds"])
            self._resumed_worlds, self._fresh, why = True, False, ""
        anew = f"episodes begin anew ({why})" if why else ""
        self.resumed = "the worlds go on where they were" if self._resumed_worlds else anew

    def policy(self) -> Any:
        """Return the actor, the averaged one with ``average``, deterministic, in evaluation mode: observations
        TensorDict -> actions [N, A]."""
        if self._averaged:
            return load_policy(self.payload(), self.env, "the average of this run", self._typed)
        self.alg.eval_mode()
        return by_episode(self.alg.get_policy(), self.env)
