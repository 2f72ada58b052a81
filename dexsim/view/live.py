"""A live view of a policy in a browser: the hand, the object, what the fingertips feel, rewards, and controls.

`dexsim play checkpoint=PATH view=true` serves one web page (viser), on this machine only unless
`view_host` says otherwise; nothing here needs a display. The environment steps in the main thread, in real time where
it can; the page's controls only set what the loop reads next.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from dexsim.errors import UserError
from dexsim.sim.scene import OBJECT
from dexsim.view import live_gate
from dexsim.view import live_panels as panels
from dexsim.view.live_meshes import body_meshes
from dexsim.view.render import CAMERA, backdrop

PROGRESS = "progress.csv"
Policy = Callable[[Any], torch.Tensor]  # observations -> actions [N, A]
SPEEDS = {"1/10": 0.1, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "fastest": float("inf")}
BUTTONS = {"step": 1, "10 steps": 10, "new episodes": 0}
MOST_STEPS = 1000  # asked for and not yet taken
MOST_FAILED_DRAWS = 100  # in a row, before the view gives up
SCENE_HZ, PANEL_HZ = 30.0, 8.0
LIFT = 4e-4  # m, taxels are drawn this much above the skin
RUN_S = 2.0  # between two looks at a training's folder
MOST_CHECKPOINTS = 10**6
FULL_TAXEL = 0.25  # N, darkest colour until more was felt


@dataclass
class Wishes:
    """Requests of the page; read and cleared by the loop."""

    pause: bool = False
    steps: int = 0
    world: int = 0
    speed: str = "1"
    restart: bool = False
    policy: str | None = None
    command: float | None = None
    changed: threading.Event = field(default_factory=threading.Event)


class Run:
    """The training that a checkpoint is of, seen from its folder. newest: the policy that it saves over and over;
    files: of the page, by name; checkpoints that are saved later are added."""

    def __init__(self, source: Path, files: dict[str, Path]):
        self.newest, self._folder, self._files = source.name, source.parent, files
        self._stamp = self._time()

    def _time(self) -> float:
        path = self._folder / self.newest
        return path.stat().st_mtime if path.is_file() else 0.0

    def names(self) -> list[str]:
        """List the checkpoints by iteration, then the newest policy."""
        saved = [p for p in self._folder.glob("model_*.pt") if p.stem.removeprefix("model_").isdigit()]
        saved.sort(key=lambda p: int(p.stem.removeprefix("model_")))
        self._files.update({p.name: p for p in saved})
        return [*(p.name for p in saved if p.name != self.newest), self.newest]

    def changed(self) -> bool:
        """Tell whether the newest policy was saved again since this was last asked."""
        before, self._stamp = self._stamp, self._time()
        return self._stamp != before

    def panel(self) -> str:
        """Give HTML: how it learns, by its progress.csv."""
        from dexsim.view.plots import read_progress

        try:
            return panels.training(read_progress(self._folder / PROGRESS))
        except (OSError, ValueError, UserError):  # in the middle of a line
            return ""


class LiveView:
    """One environment, one policy, one page.

    Args:
        env: a `dexsim.tasks.env.HandEnv` (raw taxel forces are shown if `env.touch.raw` is there).
        policy: observations to actions [N, 12]. name: its name among `choices`.
        choices: names of policies to switch to. load: name to policy; may raise UserError, which the page then shows.
        host, port: where to serve. Raises UserError where that cannot be.
        run: the training that the policies are of: its checkpoints come to the page as they are saved.
    """

    def __init__(
        self, env: Any, policy: Policy, name: str, choices: list[str], load: Callable[[str], Policy], host: str,
        port: int, run: Run | None = None,
    ) -> None:  # fmt: skip
        viser: Any = importlib.import_module("viser")  # slow to load

        live_gate.check_free(host, port)
        self.env, self.policy, self.name, self._load = env, policy, name, load
        self.wishes, self._run = Wishes(), run
        self._asked_run = 0.0
        self.fingers = list(env.hand.finger_names)
        self._map = panels.TaxelMap(env.touch.layout)
        self._full_taxel, self._full_force, self._full_reward = (
            FULL_TAXEL,
            float(np.ceil(getattr(env, "f_max", 10.0))),
            0.5,
        )
        self._terms: dict[str, torch.Tensor] = {}
        self._totals: dict[str, float] = {}
        self._rewards = env.rewards
        env.rewards = self._keep_rewards
        env.graphs = False  # a recorded step would run past _keep_rewards
        self.steps, self.episodes, self.ended = 0, 0, "-"
        self._message, self._world, self._stopped = "", 0, threading.Event()
        self._command: float | None = None
        self.gate = live_gate.Gate(host)
        self._failed_draws = 0
        # its banner; the address is ours to say
        with contextlib.redirect_stdout(io.StringIO()), live_gate.gated(self.gate):
            self.server = viser.ViserServer(host=host, port=port, label="dexsim", verbose=False)
        self._names: list[str] = []
        self._nodes: dict[int, Any] = {}
        self._object: list[Any] = []
        self._lay_out(choices)
        self._show_world()
        self.draw(panels_too=True)

    @property
    def port(self) -> int:
        """Where it is served."""
        return self.server.get_port()

    @property
    def token(self) -> str:
        """The token that the address must carry as ?token=..., '' where it is served on this machine only."""
        return self.gate.token

    # -- the page
    def _lay_out(self, choices: list[str]) -> None:
        server, gui, w = self.server, self.server.gui, self.wishes
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(hdri=None)
        scene = server.scene
        scene.add_light_ambient("/light/all", intensity=1.1)
        scene.add_light_hemisphere("/light/sky", sky_color=(255, 255, 255), ground_color=(130, 130, 140), intensity=1.5)
        scene.add_light_point("/light/front", position=(0.35, -0.25, 0.45), intensity=1.2, decay=1.0)
        scene.set_background_image(backdrop(64, 64))
        azimuth, elevation = np.radians(CAMERA["azimuth"]), np.radians(CAMERA["elevation"])
        away = -np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        camera = server.initial_camera
        look = np.array(CAMERA["lookat"]) + [0.0, 0.0, 0.02]
        camera.look_at, camera.position, camera.near = tuple(look), tuple(look + 0.7 * CAMERA["distance"] * away), 0.005
        with gui.add_folder("Controls"):
            pause = gui.add_checkbox("pause", initial_value=False)
            buttons = gui.add_button_group("", tuple(BUTTONS))
            speed = gui.add_button_group("speed", tuple(SPEEDS))
            world = gui.add_slider(
                "world", min=0, max=max(self.env.num_envs - 1, 1), step=1, initial_value=0,
                disabled=self.env.num_envs == 1,
            )  # fmt: skip
            policy = gui.add_dropdown("policy", choices, initial_value=self.name)
            at = gui.add_slider("checkpoint", min=0, max=1, step=1, initial_value=1, visible=self._run is not None)
            own = gui.add_checkbox("own command", initial_value=False, visible=hasattr(self.env, "fixed_command"))
            command = gui.add_slider(
                "command", min=0.0, max=1.0, step=0.05, initial_value=0.5, disabled=True,
                visible=hasattr(self.env, "fixed_command"),
            )  # fmt: skip
        self._facts = gui.add_html("")
        with gui.add_folder("Touch"):
            feels = bool(self.env.pads)
            self._labels = gui.add_html(panels.pad_labels(list(self.env.touch.layout.names)), visible=feels)
            self._image = gui.add_image(
                self._map.image(np.zeros(self.env.touch.layout.area.shape), 1.0), format="png", visible=feels
            )
            self._forces = gui.add_html("")
        with gui.add_folder("Training", visible=self._run is not None):
            self._training = gui.add_html("")
        self._policy_choice, self._checkpoint, self._choices = policy, at, choices
        with gui.add_folder("Rewards"):
            self._reward_html = gui.add_html("")
        live_gate.only_known(
            server,
            {
                h._impl.uuid: check
                for h, check in (
                    (pause, live_gate.truth), (own, live_gate.truth), (buttons, live_gate.one_of(BUTTONS)),
                    (speed, live_gate.one_of(SPEEDS)), (world, live_gate.number(0, max(self.env.num_envs - 1, 1))),
                    (policy, live_gate.one_of(choices)), (at, live_gate.number(0, MOST_CHECKPOINTS)),
                    (command, live_gate.number(0, 1)),
                )
            },
        )

        def on(wish: str, value: Callable[[], Any]) -> Callable[[Any], None]:
            def answer(_: Any) -> None:
                setattr(w, wish, value())
                w.changed.set()

            return answer

        def pressed() -> int:
            steps = BUTTONS[buttons.value]
            w.restart |= not steps
            if steps:
                w.pause = pause.value = True
            return min(w.steps + steps, MOST_STEPS)

        def commanded() -> float | None:
            command.disabled = not own.value
            return float(command.value) if own.value else None

        pause.on_update(on("pause", lambda: bool(pause.value)))
        buttons.on_click(on("steps", pressed))
        speed.on_click(on("speed", lambda: speed.value))
        world.on_update(on("world", lambda: min(int(world.value), self.env.num_envs - 1)))
        policy.on_update(on("policy", lambda: policy.value))
        at.on_update(on("policy", lambda: self._names[: int(at.value) + 1][-1] if self._names else None))
        own.on_update(on("command", commanded))
        command.on_update(on("command", commanded))

    def _show_world(self) -> None:
        """Show the meshes of the chosen world: the hand once, the object anew (its shape differs by world and
        episode)."""
        model = self.env.drawn_model(self.wishes.world)
        self._model, self._data = model, mujoco.MjData(model)
        scene, thing = self.server.scene, model.body(OBJECT).id
        meshes = body_meshes(model)
        if not self._nodes:
            for body in range(model.nbody):
                self._nodes[body] = scene.add_frame(f"/bodies/{body}", show_axes=False)
                for k, mesh in enumerate(meshes.get(body, []) if body != thing else []):
                    scene.add_mesh_simple(
                        f"/bodies/{body}/{k}", mesh.vertices.astype(np.float32), mesh.faces, color=_lighter(mesh.rgba),
                        opacity=None if mesh.rgba[3] >= 1 else mesh.rgba[3], flat_shading=True,
                    )  # fmt: skip
            layout = self.env.touch.layout
            self._points = []
            for f, name in enumerate(layout.bodies if self.env.pads else ()):
                count = int(layout.count[f])
                self._points.append(
                    scene.add_point_cloud(
                        f"/bodies/{model.body(name).id}/taxels",
                        (layout.point[f, :count] + LIFT * layout.normal[f, :count]).astype(np.float32),
                        np.full((count, 3), 210, np.uint8), point_size=0.0011, point_shape="circle",
                        precision="float32", point_shading="flat",
                    )
                )
        for old in self._object:
            old.remove()
        self._object = [
            scene.add_mesh_simple(
                f"/bodies/{thing}/object{k}", m.vertices.astype(np.float32), m.faces, color=_lighter(m.rgba),
                flat_shading=True,
            )
            for k, m in enumerate(meshes.get(thing, []))
        ]

    def draw(self, panels_too: bool) -> None:
        """Bring the page to the present state of the chosen world; reads from the device. What fails between here and a
        page costs a picture, not the run, unless it fails again and again."""
        try:
            self._draw(panels_too)
            self._failed_draws = 0
        except Exception:
            self._failed_draws += 1
            if self._failed_draws >= MOST_FAILED_DRAWS:
                raise

    def _draw(self, panels_too: bool) -> None:
        env, w = self.env, self.wishes.world
        self._data.qpos[:] = env.engine.t.qpos[w].cpu().numpy()
        mujoco.mj_kinematics(self._model, self._data)
        raw = env.touch.raw
        with self.server.atomic():
            for body, node in self._nodes.items():
                node.position, node.wxyz = self._data.xpos[body], self._data.xquat[body]
            if raw is not None:
                forces = raw[w].cpu().numpy()
                self._full_taxel = max(0.995 * self._full_taxel, FULL_TAXEL, float(forces.max()))
                for f, cloud in enumerate(self._points):
                    cloud.colors = panels.colours(forces[f][: len(cloud.points)], self._full_taxel)
        if not panels_too:
            return
        if raw is not None:
            self._image.image = self._map.image(forces, self._full_taxel)
        force = env.touch.force[w].cpu().numpy()
        fingers = force[: len(self.fingers)]
        commanded = env.commanded_force()[w].cpu().numpy() if hasattr(env, "commanded_force") else None
        self._forces.content = panels.force_bars(self.fingers, fingers, commanded, self._full_force)
        terms = {k: float(v[w]) for k, v in self._terms.items()}
        self._full_reward = max([0.99 * self._full_reward, 0.05, *(abs(v) for v in terms.values())])
        if terms:
            self._reward_html.content = panels.reward_bars(terms, self._totals, self._full_reward)
        self._facts.content = panels.facts(self._about(w))

    def _about(self, world: int) -> dict[str, object]:
        env = self.env
        variant = env.objects.scene.variants[int(env.objects.variant[world])]
        rows = {
            "time": f"{int(env.episode_length_buf[world]) * env.dt:.2f} s of the episode",
            "step": self.steps,
            "state": "paused" if self.wishes.pause else "running",
            "world": f"{world} of {env.num_envs}",
            "policy": self.name,
            "object": f"{variant.shape.name}, {1e3 * float(env.objects.mass[world]):.0f} g, friction"
            f" {float(env.objects.friction[world]):.2f}",
            "last episode": f"{self.ended} ({self.episodes} ended)",
        }
        return rows | ({"": self._message} if self._message else {})

    def _follow(self) -> None:
        """Bring what the run has saved and logged since to the page: a slider position for each checkpoint, the last
        for the newest policy, which is played anew as it changes."""
        now = time.perf_counter()
        if self._run is None or now - self._asked_run < RUN_S:
            return
        self._asked_run = now
        names, at = self._run.names(), self._checkpoint
        if names != self._names and names:
            last = at.value >= len(self._names) - 1
            self._names = names
            self._choices[:] = [*reversed(names), *(x for x in self._choices if x not in names)]
            self._policy_choice.options = tuple(self._choices)
            at.max = max(len(names) - 1, 1)
            if last:
                at.value = len(names) - 1
        if self._run.changed() and self.name == self._run.newest:
            with contextlib.suppress(UserError):
                self.policy = self._load(self.name)
        self._training.content = self._run.panel()

    # -- the loop
    def _keep_rewards(self) -> dict[str, torch.Tensor]:
        self._terms = self._rewards()
        return self._terms

    def run(self, seconds: float | None = None) -> None:
        """Step and draw until Ctrl-C (or for `seconds`, or until `stop`)."""
        env, w = self.env, self.wishes
        self._asked_run = 0.0
        end = None if seconds is None else time.perf_counter() + seconds
        drawn = shown_at = 0.0
        due = time.perf_counter()
        with torch.no_grad():
            obs = env.get_observations()
            while not self._stopped.is_set() and (end is None or time.perf_counter() < end):
                self._follow()
                if self._obey():
                    obs = env.get_observations()
                    self.draw(panels_too=True)
                if w.pause and not w.steps:
                    w.changed.wait(0.1)
                    w.changed.clear()
                    due = time.perf_counter()
                    continue
                w.steps = max(w.steps - 1, 0)
                obs = self._step(obs)
                now = time.perf_counter()
                last = w.pause and not w.steps
                if last or now - drawn >= 1 / SCENE_HZ:
                    panels_too = last or now - shown_at >= 1 / PANEL_HZ
                    self.draw(panels_too)
                    drawn, shown_at = now, now if panels_too else shown_at
                if w.speed != "fastest" and not w.pause:
                    due = max(due + env.dt / SPEEDS[w.speed], time.perf_counter() - 0.2)  # too slow: do not catch up
                    time.sleep(max(due - time.perf_counter(), 0.0))

    def _step(self, obs: Any) -> Any:
        env, w = self.env, self.wishes.world
        obs, _, done, extras = env.step(self.policy(obs))
        self.steps += 1
        for name, value in self._terms.items():
            self._totals[name] = self._totals.get(name, 0.0) + float(value[w])
        if bool(done[w]):
            self.episodes += 1
            timed_out = bool(extras["time_outs"][w])
            self.ended = f"{'to the time limit' if timed_out else 'ended early'}, {sum(self._totals.values()):+.1f}"
            self._new_episode()
        return obs

    def _new_episode(self) -> None:
        self._totals = {}
        self._show_world()

    def _obey(self) -> bool:
        """Return the do what the page asked for; True where the state was changed or another world is looked at."""
        env, w = self.env, self.wishes
        changed = w.world != self._world
        if changed:
            self._world = w.world
            self._new_episode()
        if hasattr(env, "fixed_command") and w.command != self._command:
            self._command = w.command
            env.fixed_command = None if w.command is None else torch.full((env.num_envs,), w.command, device=env.device)
            env.command_left.zero_()
            changed = True
        if w.policy is not None:
            name, w.policy = w.policy, None
            changed = True
            try:
                self.policy, self.name, self._message = self._load(name), name, ""
                w.restart = True
            except UserError as error:
                self._message = str(error)
        if w.restart:
            w.restart, changed = False, True
            env.reset_all()
            self.steps, self._terms = 0, {}
            self._reward_html.content = ""
            self._new_episode()
        return changed

    def stop(self) -> None:
        """End `run` and the server (from any thread)."""
        self._stopped.set()
        self.wishes.changed.set()
        self.server.stop()


def _lighter(rgba: tuple[float, float, float, float]) -> tuple[float, float, float]:
    """Return a black hand shows no form in a browser's plain light: dark colours are lifted."""
    r, g, b = (c + 0.16 * (1 - c) ** 2 for c in rgba[:3])
    return r, g, b
