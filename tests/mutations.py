"""Do the tests bite? Breaks the package one line at a time and says whether the test that should notice does.

    python -m tests.mutations            all of them, about ten seconds each; by hand or nightly
    python -m tests.mutations grasp_eval those whose file or words hold all that is typed

Each mutation is applied to a temporary copy of the package, never to this one. Ends with status 1 if one survives, or
if a test fails without any mutation (its word would then say nothing).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("dexsim", "tests")
SECONDS = 600
"""Most that one test may take, s."""


@dataclass(frozen=True)
class Mutation:
    """file: below the repository's root; old: text that stands in it exactly once; new: what replaces it; test: what
    must fail then, as pytest names it."""

    breaks: str
    file: str
    old: str
    new: str
    test: str


def _constant(breaks: str, file: str, name: str, old: str, new: str, test: str) -> Mutation:
    return Mutation(breaks, file, f"{name} = {old}", f"{name} = {new}", test)


def _never_drawn(task: str, file: str, name: str, instead: str, columns: str = "") -> Mutation:
    """Return a range of which every world gets the same value; file: where it is drawn."""
    drawn = f's.draw("{name}"{columns})'
    return Mutation(
        f"{name} of {task} is never drawn",
        f"dexsim/tasks/{file}.py",
        drawn,
        f"(0.0 * {drawn} + {instead})",
        f"tests/test_drawn.py::test_every_range_is_drawn_over_its_whole_width[{task}]",
    )


GRASP_EVAL, GRASP, ROTATE = "dexsim/tasks/grasp_eval.py", "dexsim/tasks/grasp.py", "dexsim/tasks/rotate.py"
FINGERTIPS, TASK = "dexsim/tasks/rotate_fingertips.py", "dexsim/tasks/task.py"
MUTATIONS = (
    Mutation(
        "the evaluated hand is not turned",
        GRASP_EVAL,
        "9.81 * _turned(down, axis, _angle(t))",
        "9.81 * down",
        "tests/test_grasp_eval.py::test_the_hand_is_turned_by_90_and_by_180_degrees",
    ),
    Mutation(
        "the evaluated object is not pushed",
        GRASP_EVAL,
        "torch.where(pushing[:, None], push_force, torch.zeros_like(push_force))",
        "torch.zeros_like(push_force)",
        "tests/test_grasp_eval.py::test_every_second_world_is_pushed_by_twice_its_weight_for_half_a_second",
    ),
    Mutation(
        "the evaluation's push does not reach the object",
        "dexsim/tasks/grasp_kernels.py",
        "force = outside[w, c]",
        "force = float(0.0)",
        "tests/test_grasp.py::test_a_force_and_a_turned_hand_move_the_object_as_the_evaluation_means_it",
    ),
    Mutation(
        "a bound hides that a reward is not finite",
        "dexsim/tasks/grasp_rewards.py",
        "return wp.where(x > high, high, x)",
        "return wp.where(x <= high, x, high)",
        "tests/test_step_kernels.py::test_a_number_that_is_not_finite_is_not_hidden_by_a_bound[mujoco]",
    ),
    Mutation(
        "a reward that is not finite is put down to another",
        "dexsim/tasks/state_kernels.py",
        "wp.atomic_add(wrong, 1 + k, wp.int64(1))",
        "wp.atomic_add(wrong, k, wp.int64(1))",
        "tests/test_step_kernels.py::test_who_ends_and_what_is_earned[mujoco]",
    ),
    Mutation(
        "the inverse weight of an object is its mass",
        "dexsim/tasks/object_kernel.py",
        "f.body_invweight0[w, body, 0] = real(1.0 / mass)",
        "f.body_invweight0[w, body, 0] = real(mass)",
        "tests/test_object_kernel.py::test_a_write_is_what_it_is_in_torch[mujoco]",
    ),
    Mutation(
        "an object counts as held 150 mm away",
        GRASP_EVAL,
        "SETTLE, HOLD, RADIUS = 2.0, 5.0, 0.030",
        "SETTLE, HOLD, RADIUS = 2.0, 5.0, 0.150",
        "tests/test_grasp_eval.py::test_held_is_within_30_mm_of_where_it_settled",
    ),
    Mutation(
        "an object counts as held untouched",
        GRASP_EVAL,
        "good = alive & touched & near",
        "good = alive & near",
        "tests/test_grasp_eval.py::test_held_is_touched_by_the_thumb_and_a_finger",
    ),
    Mutation(
        "only a quarter of the load must be held",
        GRASP_EVAL,
        '>= 2 * r["load"]',
        '>= 8 * r["load"]',
        "tests/test_grasp_eval.py::test_what_must_be_held_is_what_the_commanded_forces_can_carry",
    ),
    _never_drawn("grasp", "task", "contact.stiffness", "7000.0"),
    _never_drawn("grasp", "task", "contact.damping_ratio", "0.75"),
    _never_drawn("grasp", "grasp_launch", "sensors.torque_bias", "0.0", ", self.num_actions"),
    _never_drawn("grasp", "grasp_launch", "initial.tilt", "0.0"),
    _never_drawn("rotate", "task", "object.friction", "0.9"),
    _never_drawn("rotate", "task", "object.mass", "0.08"),
    _never_drawn("rotate", "task", "contact.stiffness", "7000.0"),
    _never_drawn("rotate", "parts", "imu.tilt", "0.0", ", 3"),
    Mutation(
        "the first finger is taken for the thumb",
        "dexsim/tasks/grasp_rewards.py",
        "if shape.opposing[i] == f:",
        "if f == 0:",
        "tests/test_any_hand.py::"
        "test_the_finger_that_presses_against_the_others_is_paid_for_a_band_wherever_it_stands",
    ),
    Mutation(
        "the grasp's actor is told the true force",
        TASK,
        "(self.touch.force_clean if self.clean else self.touch.force)",
        "self.touch.force_clean",
        "tests/test_grasp.py::test_the_actor_feels_what_the_sensor_measured",
    ),
    Mutation(
        "the grasp's actor is told the true centres",
        TASK,
        "(self.touch.centre_clean if self.clean else self.touch.centre)",
        "self.touch.centre_clean",
        "tests/test_grasp.py::test_the_actor_feels_what_the_sensor_measured",
    ),
    Mutation(
        "the rotation's actor is told the true force",
        TASK,
        "(self.touch.force_clean if self.clean else self.touch.force)",
        "self.touch.force_clean",
        "tests/test_rotate.py::test_the_actor_feels_what_the_sensor_measured",
    ),
    Mutation(
        "the rotation's actor is told the true centres",
        TASK,
        "(self.touch.centre_clean if self.clean else self.touch.centre)",
        "self.touch.centre_clean",
        "tests/test_rotate.py::test_the_actor_feels_what_the_sensor_measured",
    ),
    Mutation(
        "the fingertip task's palm always looks up",
        FINGERTIPS,
        "self.palms = torch.tensor([PALMS.index(p)",
        "self.palms = torch.tensor([0 * PALMS.index(p)",
        "tests/test_rotate_fingertips.py::test_the_palm_looks_where_it_is_told",
    ),
    Mutation(
        "goals of the fingertip task turn one way only",
        FINGERTIPS,
        "signed = torch.cat([axes, -axes])",
        "signed = torch.cat([axes, axes])",
        "tests/test_rotate_fingertips.py::test_goals_turn_about_every_axis_both_ways_and_stay_in_reach",
    ),
    Mutation(
        "goals of the fingertip task have no reach",
        FINGERTIPS,
        "far <= self.reach_rad",
        "far <= 9.0",
        "tests/test_rotate_fingertips.py::test_goals_turn_about_every_axis_both_ways_and_stay_in_reach",
    ),
    Mutation(
        "the camera is not late",
        FINGERTIPS,
        "late = self.camera_delay.clamp",
        "late = (0 * self.camera_delay).clamp",
        "tests/test_rotate_fingertips.py::test_the_pose_is_late_by_its_delay",
    ),
    Mutation(
        "the camera always sees",
        FINGERTIPS,
        "sees = (~gone)[:, None]",
        "sees = (~gone | gone)[:, None]",
        "tests/test_rotate_fingertips.py::test_a_hidden_pose_stays_as_it_was_and_ages",
    ),
    Mutation(
        "nothing is pushed",
        FINGERTIPS,
        "self.push(torch.where((on & ~over)[:, None], self.push_force, 0.0))",
        "pass",
        "tests/test_rotate_fingertips.py::test_pushes_come_and_are_as_strong_as_they_say",
    ),
    Mutation(
        "the palm may carry the cube",
        FINGERTIPS,
        'self.tipped = self.leaning > limit["lean_s"]',
        "self.tipped = self.leaning < -1.0",
        "tests/test_rotate_fingertips.py::test_what_rests_on_the_palm_is_counted_and_ends",
    ),
    Mutation(
        "the palm's touch is not counted",
        FINGERTIPS,
        "clamp(min=0).sum(1) + self.palm_force",
        "clamp(min=0).sum(1)",
        "tests/test_rotate_fingertips.py::test_what_rests_on_the_palm_is_counted_and_ends",
    ),
    Mutation(
        "the fingertip actor knows the friction",
        FINGERTIPS,
        "return self.seen_position",
        "return self.seen_position + self.objects.friction[:, None]",
        "tests/test_rotate_fingertips.py::test_the_actor_does_not_know_size_mass_or_friction",
    ),
    Mutation(
        "an evaluation gives up goals",
        FINGERTIPS,
        "self.patience.fill_(math.inf)",
        "pass",
        "tests/test_rotate_fingertips.py::test_a_goal_that_is_not_reached_is_replaced_in_training_only",
    ),
    Mutation(
        "the other world feels as training does",
        "dexsim/tasks/reality.py",
        'cfg["tactile"].update(world["tactile"])',
        "pass",
        "tests/test_reality.py::test_touch_is_its_own",
    ),
    Mutation(
        "a search names what removes nothing",
        "dexsim/gap/rules.py",
        "    least: float = 0.12\n",
        "    least: float = 0.0\n",
        "tests/test_gap_rules.py::test_an_effect_must_remove_a_least_share",
    ),
    Mutation(
        "a name that removes nothing of what was held out is sure",
        "dexsim/gap/rules.py",
        "    part: float = 0.2\n",
        "    part: float = 0.0\n",
        "tests/test_gap_least.py::test_an_effect_must_remove_a_part_of_what_was_held_out",
    ),
    Mutation(
        "a touch effect that removes nothing is named",
        "dexsim/gap/rules.py",
        "    least: float = 0.12\n",
        "    least: float = 0.0\n",
        "tests/test_gap_rules_touch.py::test_a_touch_effect_must_remove_a_least_share",
    ),
    Mutation(
        "inverse dynamics name what removes nothing",
        "dexsim/gap/rules.py",
        "    least: float = 0.12\n",
        "    least: float = 0.0\n",
        "tests/test_gap_inverse.py::test_further_effects_are_named_one_after_another",
    ),
    Mutation(
        "a joint whose ringing is explained is said to be pushed",
        "dexsim/gap/judge/conclude.py",
        "(p.joint in d.ringing or _followed(d, p.joint))",
        "_followed(d, p.joint)",
        "tests/test_gap_ringing.py::test_what_is_followed_to_the_noise_is_not_pushed",
    ),
    Mutation(
        "a joint that rings as white as noise is noisy, whatever its torque does",
        "dexsim/gap/plant/case.py",
        "return usual if _torque_scatter(runs, j, others, limits) > BELIEF.noisier * own / usual else None",
        "return None",
        "tests/test_gap_rules_belief.py::test_a_joint_that_rings_all_the_time_has_the_others_noise",
    ),
    Mutation(
        "the model's stops stand where a misread joint was recorded to be",
        "dexsim/gap/plant/kernel.py",
        "p.low = wp.min(c.consts[C_LOW], (c.consts[C_LOW] - p.offset) * per)",
        "p.low = c.consts[C_LOW]",
        "tests/test_gap_ends.py::test_no_end_is_where_a_joint_was_recorded_to_be",
    ),
    Mutation(
        "of a dead zone one kind is tried",
        "dexsim/gap/effects/drive.py",
        "    kinds = 3\n",
        "",
        "tests/test_gap_rules.py::test_every_kind_of_a_dead_zone_is_tried",
    ),
    Mutation(
        "the crest of a fast reversal is cut off as spikes",
        "dexsim/recording/spikes.py",
        "        if b - a > ROW:\n            continue\n",
        "",
        "tests/test_spikes.py::test_the_crest_of_a_fast_reversal_with_a_message_missing_has_no_spike",
    ),
    Mutation(
        "an effect is taken back that one moment of what was held out speaks against",
        "dexsim/gap/judge/joint_answer.py",
        "held_out.gain_interval(lost, self.after, self.t)[1] < JUDGE.part",
        "True",
        "tests/test_gap_verdict.py::test_what_was_held_out_takes_one_of_several_effects_back",
    ),
    Mutation(
        "what makes a joint ring is taken back by a free run that cannot keep step",
        "dexsim/gap/judge/joint_answer.py",
        "            if mm.effect.effort_only or mm.effect.rings:\n                continue\n",
        "",
        "tests/test_gap_verdict.py::test_what_was_held_out_takes_one_of_several_effects_back",
    ),
    Mutation(
        "a whisper about an effort's sensor decides the verdict",
        "dexsim/gap/judge/held_out.py",
        'if f.confidence < JUDGE.firm else f',
        'if f.confidence < JUDGE.firm and f.effect != "current_sensor" else f',
        "tests/test_gap_verdict.py::test_what_is_wrong_with_an_effort_alone_is_a_hint_below_a_half",
    ),
    Mutation(
        "what no fitted recording visits makes a verdict unknown",
        "dexsim/gap/judge/conclude.py",
        'if word == "unknown" and by.shown is not None:',
        "if False:",
        "tests/test_gap_verdict.py::test_what_no_fitted_recording_shows_makes_no_verdict_unknown",
    ),
    Mutation(
        "a name that only harms stays on a joint that rings",
        "dexsim/gap/judge/conclude.py",
        'if rings and name == "found" and held_out',
        'if False and rings and name == "found" and held_out',
        "tests/test_gap_ringing.py::test_a_joint_that_rings_is_exempt_only_where_its_error_does_not_surely_rise",
    ),
    Mutation(
        "friction by load may forbid a motion that was recorded",
        "dexsim/gap/search/baseline.py",
        "    level = level + gear_load_friction(",
        "    level = level + 0.0 * gear_load_friction(",
        "tests/test_gap_baseline.py::test_breakaway_and_friction_by_load_may_forbid_a_fall_too",
    ),
    Mutation(
        "a joint swings ahead of its target where a lag fits nearly as well",
        "dexsim/gap/read/channels.py",
        " and scores[best] > causal + SIGNAL.beyond",
        "",
        "tests/test_gap_rules_signal.py::test_a_lead_is_told_by_a_clear_correlation",
    ),
    Mutation(
        "messages of one length are decoded at once though a name in them differs",
        "dexsim/recording/stacked.py",
        "if not all((raw[:, part] == first[part]).all() for part in rest):",
        "if False and not all((raw[:, part] == first[part]).all() for part in rest):",
        "tests/test_recording_stacked.py::test_any_byte_that_differs_is_a_number_s_or_none_is_decoded_at_once",
    ),
    Mutation(
        "all windows begin where the first one does",
        "dexsim/gap/plant/kernel.py",
        "    of = wp.min(w, c.inits.shape[1] - 1)",
        "    of = 0 * wp.min(w, c.inits.shape[1] - 1)",
        "tests/test_gap_fits.py::test_windows_may_begin_each_from_its_own_place_and_end_early",
    ),
    Mutation(
        "a name that only harms is written",
        "dexsim/gap/judge/full_model.py",
        "    named = min(alike, max(belief, quiet))",
        "    named = math.inf",
        "tests/test_gap_confirm.py::test_of_a_joint_what_follows_best_is_written",
    ),
    Mutation(
        "a joint without a loop is said to ring",
        "dexsim/gap/search/ringing.py",
        "return s.stiffness * s.span < SEARCH.doubt * s.tau",
        "return s.stiffness * s.span < 0.0 * SEARCH.doubt * s.tau",
        "tests/test_gap_ringing.py::test_nothing_makes_a_joint_ring_that_has_no_loop",
    ),
    Mutation(
        "targets far off are another unit though no loop follows them",
        "dexsim/gap/read/channels.py",
        "and not far_target(f, r.path.name, openly)",
        "and not (False and far_target(f, r.path.name, openly))",
        "tests/test_reach.py::test_far_targets_of_a_drive_without_a_loop_spoil_nothing",
    ),
)


def mutated(m: Mutation, root: Path = ROOT) -> str:
    """Return the text of a mutation's file with it. Raises ValueError where its old text does not stand there
    exactly once."""
    text = (root / m.file).read_text(encoding="utf-8")
    if text.count(m.old) != 1:
        raise ValueError(
            f"{m.file} holds {m.old!r} {text.count(m.old)} times, not once: mend the line of '{m.breaks}' in "
            "tests/mutations.py"
        )
    return text.replace(m.old, m.new)


def copy(folder: Path) -> None:
    """Copy what tests need: the package and the tests as copies, all else as links."""
    for path in ROOT.iterdir():
        if path.name in COPIED:
            shutil.copytree(path, folder / path.name, ignore=shutil.ignore_patterns("__pycache__"))
        elif not path.name.startswith("."):
            (folder / path.name).symlink_to(path)


def run(folder: Path, tests: list[str]) -> int:
    """Return pytest's status: 0 all passed, 1 some failed, above 1 they could not be run."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", f"--timeout={SECONDS}", *tests]
    env = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, check=False).returncode


def main(words: list[str]) -> int:
    """Return words: only mutations whose file or description hold them all."""
    chosen = [m for m in MUTATIONS if all(w in f"{m.file} {m.breaks}" for w in words)]
    if not chosen:
        print(f"no mutation holds all of: {' '.join(words)}", file=sys.stderr)
        return 2
    bad = 0
    with tempfile.TemporaryDirectory(prefix="dexsim_mutations_") as name:
        folder = Path(name)
        copy(folder)
        if run(folder, sorted({m.test for m in chosen})) != 0:
            print("broken    the tests themselves: they fail without any mutation")
            return 1
        for m in chosen:
            path = folder / m.file
            whole = path.read_text(encoding="utf-8")
            path.write_text(mutated(m, folder), encoding="utf-8")
            status = run(folder, [m.test])
            path.write_text(whole, encoding="utf-8")
            word = {0: "survived", 1: "killed"}.get(status, f"broken ({status})")
            bad += word != "killed"
            print(f"{word:9} {m.breaks} ({m.file})", flush=True)
    print(f"{len(chosen) - bad} of {len(chosen)} killed")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
