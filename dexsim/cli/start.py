"""From a command line to the plain config that the library gets, for ``train.py`` and ``play.py``.

Names and types are checked before anything heavy is imported, so that a slip is answered at once.
"""

from __future__ import annotations

import contextlib
import copy
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from dexsim import files, yaml_text
from dexsim.assets.objects.own import PARTS
from dexsim.cli import checks, objects, settings
from dexsim.cli import help as help_page
from dexsim.errors import UserError
from dexsim.learning import policies, weights_and_biases

WORLDS = {"cpu": 64, "cuda": 8192}  # where neither the user nor the task's preset says
ITERATIONS = {"cpu": 200, "cuda": 1000}
VIEW_WORLDS = 4
MAX_PLAY_WORLDS = {"cpu": 64, "cuda": 4096}


@dataclass
class Start:
    """What a command was asked to do.

    cfg: resolved config. play: play.py's own settings ({} for train.py). source: the checkpoint's path, or None.
    data: the checkpoint, as :func:`dexsim.learning.checkpoint.load` returns it, or None.
    typed: the settings of the command line itself, (name, value), which alone may name code (dexsim.learning.names).
    given: the names of all of them.
    """

    cfg: dict[str, Any]
    play: dict[str, Any]
    source: str | None = None
    data: dict[str, Any] | None = None
    typed: frozenset[tuple[str, Any]] = frozenset()
    given: tuple[str, ...] = ()


def for_train(argv: list[str], config_dir: Path) -> Start | None:
    """Return settings of a training run; None when the command only asked for help or the settings (printed)."""
    given, only_show = _flags(argv, config_dir, "train")
    if given is None:
        return None
    request = settings.parse(given, config_dir)
    source, data = _last(request, "resume"), None
    if source is not None:
        from dexsim.learning.ranks import Ranks

        with Ranks().leaders(source) as place:
            data = _load(place)
    with _blamed(source if data is not None else None, request):
        forget = {"run": None, "out": None, "device": None}
        plain, kind = _settled(data, source, config_dir, request, forget, ranked=True)
        if _another_world(plain):
            raise UserError(
                f"reality={plain['reality']['name']}: a world to be judged in, not to train in; give it to play.py"
            )
        plain["worlds"] = WORLDS[kind] if plain["worlds"] is None else plain["worlds"]
        plain["iterations"] = ITERATIONS[kind] if plain["iterations"] is None else plain["iterations"]
        checks.check(plain)
    if checks.get(plain, "agent.logger") == "wandb":
        weights_and_biases.check_installed()  # before anything is built
    if only_show and _show(plain):
        return None
    return Start(plain, {}, source, data, settings.typed(request), settings.given(request))


def for_play(argv: list[str], config_dir: Path) -> Start | None:
    """Return settings of a replay; None when the command only asked for help or the settings (printed)."""
    given, only_show = _flags(argv, config_dir, "play")
    if given is None:
        return None
    if any(a.startswith("replay=") and a not in ("replay=null", "replay=") for a in given):  # commands, not a policy
        from dexsim.cli import recorded

        play = recorded.settings(given, config_dir)
        return None if only_show and _show(play) else Start({}, play, play["replay"])
    request = settings.parse(given, config_dir)
    own = _yaml(config_dir / "play.yaml")
    OmegaConf.set_struct(own, True)
    settings.override(own, [item for item in request.values if item.key_or_group in own])
    request.values = [item for item in request.values if item.key_or_group not in own]
    play = settings.resolve(own)
    if (play["checkpoint"] is None) == (play["policy"] is None):
        raise UserError(
            "say what to play: checkpoint=PATH, policy=random|zero|scripted with task=<name>, or replay=FILE"
        )
    if play["policy"] not in (None, "random", "zero", "scripted"):
        raise UserError(f"policy={play['policy']}: must be random, zero or scripted (a trained one is checkpoint=PATH)")
    if play["checkpoint"] is not None:
        play["checkpoint"] = str(policies.place(play["checkpoint"]))
    data = _load(play["checkpoint"]) if play["checkpoint"] is not None else None
    with _blamed(play["checkpoint"] if data is not None else None, request):
        plain, kind = _settled(data, play["checkpoint"], config_dir, request, {"device": play["device"]})
        if _another_world(plain):  # on the CPU, all trials at once: C MuJoCo has a thread pool
            plain, kind = _elsewhere(plain, play), "cuda"
        checks.check(play)
        if play["view"]:
            play["worlds"] = play["worlds"] or VIEW_WORLDS
            plain["tactile"]["raw"] = True  # the page shows every taxel
        play["worlds"] = play["worlds"] or min(play["episodes"], MAX_PLAY_WORLDS[kind])
        plain.update(worlds=play["worlds"], seed=play["seed"], iterations=plain["iterations"] or 1)
        checks.check(plain | {"agent": {}})
    return (
        None
        if only_show and _show(plain | play)
        else Start(plain, play, play["checkpoint"], data, settings.typed(request), settings.given(request))
    )


@contextlib.contextmanager
def _blamed(source: Any, request: settings.Request) -> Iterator[None]:
    """Yield errors of settings that a checkpoint holds, and this command did not type, name its file."""
    try:
        yield
    except UserError as error:
        text = str(error)
        about = re.match(r"[\w.]*", text).group()  # type: ignore[union-attr]  # it matches nothing, too
        typed = [*request.choices, *(item.key_or_group for item in request.values)]
        if source is None or str(source) in text or any(about == t or about.startswith(f"{t}.") for t in typed):
            raise
        raise UserError(f"{source}: its settings: {text}") from None


def _flags(argv: list[str], config_dir: Path, script: str) -> tuple[list[str] | None, bool]:
    """Take -h/--help and --cfg off; (None, ...) when the help page was printed and that is all."""
    if any(a in ("-h", "--help", "help") for a in argv):
        print(help_page.text(script, config_dir), end="")
        return None, False
    if script == "play" and not argv:
        raise UserError(
            "say what to play: checkpoint=PATH, policy=random|zero|scripted with task=<name>, or replay=FILE (--help)"
        )
    return [a for a in argv if a != "--cfg"], "--cfg" in argv


def _yaml(path: Path) -> DictConfig:
    """Return one of our own files of settings, which is a mapping."""
    cfg = OmegaConf.load(path)
    assert isinstance(cfg, DictConfig)
    return cfg


def _show(cfg: dict[str, Any]) -> bool:
    print(yaml.safe_dump(cfg, sort_keys=False), end="")
    return True


def _last(request: settings.Request, key: str) -> str | None:
    found = [item.value() for item in request.values if item.key_or_group == key]
    return None if not found or found[-1] is None else str(found[-1])


def _load(path: Any) -> dict[str, Any]:
    from dexsim.learning import checkpoint
    from dexsim.tasks import registry

    data = checkpoint.load(str(path))
    where = data["config"]["task"].get("class")
    if where is not None and where not in registry.built_in().values():
        registry.load(str(where), str(path))  # refused now, before its settings are read
    return data


def _settled(
    data: dict[str, Any] | None, source: Any, config_dir: Path, request: settings.Request, fresh: dict[str, Any],
    ranked: bool = False,
) -> tuple[dict[str, Any], str]:  # fmt: skip
    """Return the settings of a checkpoint, else of our files, with this command's applied, and the kind of device.

    source: the checkpoint's file, for messages; fresh: what goes before the earlier command's; ranked: this may be one
    of the processes that torchrun has started."""
    base = settings.from_files(config_dir, request.choices) if data is None else _stored(data, source, config_dir)
    cfg = _files(base if data is None else settings.choose(base, config_dir, request.choices), request)
    cfg.update(fresh)
    cfg = settings.override(cfg, request.values)
    from dexsim.cli import machine
    from dexsim.learning.ranks import Ranks

    device = machine.device(Ranks().device(cfg.device, machine.cuda_devices()) if ranked else cfg.device)
    kind = device.partition(":")[0]
    if data is None:
        preset = "none" if cfg.preset is None else str(cfg.preset)
        cfg = settings.apply_preset(cfg, kind if preset == "auto" else preset, request.values)
    plain = settings.resolve(cfg) | {"device": device}
    hand = files.place(plain["hand"])
    # os.path: a name that is too long for a file is none
    if os.path.exists(hand) and hand.parts != (str(plain["hand"]),):  # from wherever a checkpoint is played later
        plain["hand"] = str(hand.resolve())
    objects.apply(plain)
    return plain, kind


def _stored(data: dict[str, Any], source: Any, config_dir: Path) -> DictConfig:
    """Return the checkpoint's own config, with what is new since."""
    known = _yaml(config_dir / "config.yaml")
    plain = OmegaConf.to_container(known)
    assert isinstance(plain, dict)
    own = {str(k): v for k, v in plain.items() if k not in ("defaults", "sim")}  # a checkpoint from before has not all
    own |= dict.fromkeys(("model_file", "tactile_file", "objects", "kept_out"))  # new since
    own |= {"hand": "xhand", "hand_mirror": False, "hand_scale": 1.0, "object_scale": 1.0, "object_hulls": PARTS}
    stored = own | copy.deepcopy(data["config"])
    if _another_world(stored):
        raise UserError(f"{source}: damaged checkpoint, its settings name another world (reality)")
    cfg = OmegaConf.create(stored)
    if "sim" in cfg:
        cfg.sim = OmegaConf.merge(known.sim, cfg.sim)
    OmegaConf.set_struct(cfg, True)
    return cfg


def _another_world(plain: dict[str, Any]) -> bool:
    world = plain.get("reality") or {}  # checkpoints from before have no such group
    return not isinstance(world, dict) or world.get("name", "none") != "none"


def _elsewhere(plain: dict[str, Any], play: dict[str, Any]) -> dict[str, Any]:
    """Return the config of another world (`reality=`), on the CPU."""
    if str(play["device"] or "cpu") != "cpu":
        raise UserError(
            f"device={play['device']}: reality={plain['reality']['name']} is stepped by C MuJoCo; use device=cpu"
        )
    play["device"] = plain["device"] = "cpu"
    from dexsim.tasks.reality import overlay

    return overlay(plain)


def _files(cfg: DictConfig, request: settings.Request) -> DictConfig:
    """Put the content of the user's files into ``servo``, ``tactile`` and ``randomize``, so that overrides reach it and
    a checkpoint carries it."""
    servo, tactile, hand = (_last(request, k) for k in ("servo_file", "tactile_file", "hand"))
    OmegaConf.set_struct(cfg, False)
    from dexsim.hand import load_hand

    if hand is not None and servo is None and "servo" not in request.choices:
        servo = str(load_hand(hand).servo_path)
    if servo is not None:
        from dexsim.actuator.table import ServoTable

        path = Path(servo).expanduser()
        ServoTable.load(path)  # raises UserError
        cfg["servo"] = yaml_text.load(path, "servo file")
        cfg["choices"]["servo"] = str(path)
    if tactile is not None:
        from dexsim.tactile.file import lay_over

        lay_over(cfg, tactile, load_hand(hand or cfg.get("hand") or "xhand"))
    OmegaConf.set_struct(cfg, True)
    return cfg
