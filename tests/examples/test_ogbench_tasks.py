"""Tests of policies on OGBench's cubes: data, goals, tasks and success."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from ogbench.manipspace.oracles.markov.cube_markov import CubeMarkovOracle
from omegaconf import OmegaConf
from tensordict import TensorDict

from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs.ogbench import make_ogbench_env, ogbench_cube_reward
from torchrl_caiac.layouts import ready_layout
from torchrl_caiac.transforms import HindsightGoal

CENTRE = np.array([0.425, 0.0, 0.0])
CUBES = (19, 28)


@pytest.fixture(scope="module")
def cfg(steps, compose, tmp_path_factory):
    cfg = compose(
        "env=ogbench_cube_double_noisy",
        "method=[motion,distance_action]",
        out=tmp_path_factory.mktemp("noisy"),
    )
    steps.collect.collect(cfg)
    return cfg


def changed(cfg, **env):
    return OmegaConf.merge(cfg, {"env": env})


class Oracle:
    """OGBench's own oracle, from observations and goals alone."""

    in_keys = ("observation", "desired_goal")

    def __init__(self, scale=1):
        self.scale = scale
        env = make_ogbench_env("cube-double")
        self.bounds = SimpleNamespace(
            unwrapped=SimpleNamespace(
                _arm_sampling_bounds=env.unwrapped._arm_sampling_bounds
            )
        )
        env.close()
        self.calls = []
        self.running = {}

    def __call__(self, td):
        self.calls.append(td)
        if "is_init" in td:
            assert td["is_init"].all()
            self.running = {}
            np.random.seed(0)  # where it moves when it is done
        rows = zip(td["observation"].double().numpy(), td["desired_goal"], strict=True)
        actions = [self.act(i, *row) for i, row in enumerate(rows)]
        actions = torch.from_numpy(np.stack(actions)).float() * self.scale
        return TensorDict({"action": actions}, td.batch_size)

    def act(self, i, state, goal):
        places = [state[c : c + 3] / 10 + CENTRE for c in CUBES]
        goals = np.split(goal.double().numpy() / 10 + np.tile(CENTRE, 2), 2)
        oracle, cube = self.running.get(i, (None, 0))
        if oracle is None or oracle.done:
            # The lower one first.
            far = [
                (goals[c][2], c)
                for c in (0, 1)
                if np.linalg.norm(places[c] - goals[c]) > 0.03
            ]
            cube = min(far)[1] if far else 0
            oracle = CubeMarkovOracle(env=self.bounds)
            oracle.reset(None, None)
            self.running[i] = oracle, cube
        first = CUBES[cube]
        return oracle.select_action(
            None,
            {
                "proprio/effector_pos": state[12:15] / 10 + CENTRE,
                "proprio/effector_yaw": [np.arctan2(state[16], state[15])],
                "proprio/gripper_opening": state[17:18] / 3,
                "proprio/gripper_contact": state[18],
                "privileged/target_block": cube,
                f"privileged/block_{cube}_pos": places[cube],
                f"privileged/block_{cube}_yaw": [
                    np.arctan2(state[first + 8], state[first + 7])
                ],
                "privileged/target_block_pos": goals[cube],
                "privileged/target_block_yaw": [0.0],
            },
        )


class Still:
    in_keys = ("observation", "desired_goal")

    def __init__(self, most=4):
        self.seen = []
        self.most = most

    def __call__(self, td):
        self.seen.append(td.select(*self.in_keys).clone())
        if len(self.seen) == self.most:
            raise StopIteration
        return TensorDict({"action": torch.zeros(len(td), 5)}, td.batch_size)


def starts(environment, split):
    """The first observations and the goals of each task."""
    found = []
    for task in environment.settings.evaluate.tasks:
        own = type(environment)(
            OmegaConf.merge(environment.settings, {"evaluate": {"tasks": [task]}}),
            environment.out,
        )
        own._envs = environment._envs
        still = Still(most=1)
        with pytest.raises(StopIteration):
            own.play(still, 0, Path(), split=split)
        found.append(still.seen[0])
    return torch.cat(found)


def test_rows_are_the_first_episodes(steps, cfg):
    environment = steps.parts.make_environment(cfg)
    rows = environment.rows()
    loaded = load_transitions(environment.out / "loaded" / "rows")
    assert rows["episode"].unique().tolist() == [0, 1] and len(loaded) == 3 * 40
    assert torch.equal(rows["observation"], loaded["observation"][: 2 * 40])
    steps.collect.collect(changed(cfg, demonstrations=1))
    one = steps.parts.make_environment(changed(cfg, demonstrations=1))
    assert one.folder != environment.folder
    assert torch.equal(one.rows()["observation"], rows["observation"][:40])
    for wrong in (0, 4):
        with pytest.raises(ValueError, match="demonstrations is"):
            steps.parts.make_environment(changed(cfg, demonstrations=wrong))


def test_noisy_data_are_of_the_other_oracle(steps, compose, cfg, tmp_path):
    assert cfg.env.collect.noisy and cfg.env.demonstrations == 2
    play = compose("env=ogbench_cube_double_play", out=tmp_path)
    steps.collect.collect(play)
    shares = []
    for each in (play, cfg):
        actions = steps.parts.make_environment(each).rows()["action"]
        # The noise is 10 times as large for the gripper, which the oracle commands to
        # move all the way; a plan moves it little by little.
        shares.append(float((actions[:, 4].abs() == 1).float().mean()))
    assert shares[0] < 0.3 < 0.4 < shares[1]


def test_goals_are_positions_of_the_cubes(steps, cfg):
    environment = steps.parts.make_environment(cfg)
    rows = environment.goal_rows()
    columns = [c + i for c in CUBES for i in range(3)]
    achieved = rows["next", "observation"][:, columns]
    assert len(rows) == 80
    offsets = []
    for row in range(80):
        later = achieved[row : 40 * (row // 40 + 1)]
        same = (later == rows["desired_goal"][row]).all(-1).nonzero().flatten()
        assert len(same)
        reached = ogbench_cube_reward(achieved[row], rows["desired_goal"][row])
        assert rows["next", "reward"][row] == reached
        if len(same) == 1 and len(later) > 1:
            offsets.append(float(same[0]) / (len(later) - 1))
    # All later states are equally likely.
    assert len(offsets) > 20 and 0.3 < np.mean(offsets) < 0.7


def with_iql(compose, cfg, **learner):
    whole = compose(
        "env=ogbench_cube_double_noisy",
        "learner=iql",
        "method=[none,motion,distance_action]",
    )
    return OmegaConf.merge(whole, {"out": cfg.out, "env": cfg.env, "learner": learner})


def test_learners_of_values_sample_all_episodes(steps, compose, cfg):
    cfg = with_iql(compose, cfg, future_goals=None)
    assert cfg.learner.successful is None and cfg.learner.gamma == 0.99
    made = steps.parts.make_learner(cfg, "none")
    rb = made.make_buffer(made.rows())
    batch = rb.sample()
    # With p = 0.2, the default, goals would be 5 steps away.
    (goals,) = [t for t in rb.transform if isinstance(t, HindsightGoal)]
    assert goals.future == 0.7 and goals.p == 0.01
    assert batch["hindsight", "relabeled"].float().mean() > 0.6
    cfg.learner.successful = 0.7
    with pytest.raises(ValueError, match=r"learner.successful is 0.7.*null"):
        steps.parts.make_learner(cfg, "none")


def test_goals_of_iql_are_drawn_before_the_swap(steps, compose, cfg):
    cfg = with_iql(compose, cfg)
    assert cfg.learner.future_goals == {"uniform": 1.0}
    cfg.env.augmentation.lookahead = "goal"
    cfg.learner.future_goals = {"geometric": 1.0, "p": 0.5}
    steps.fit.fit(cfg)
    steps.score.score(cfg)
    made = steps.parts.make_learner(cfg, "distance_action")
    batch = made.make_buffer(made.rows()).sample()
    columns = [c + i for c in CUBES for i in range(3)]
    achieved = batch["next", "observation"][:, columns]
    goals = batch["desired_goal"]
    reward = ogbench_cube_reward(achieved, goals)
    assert torch.equal(batch["next", "reward"][:, 0], reward)
    assert -0.99 < reward.mean() < 0  # the next state is the goal of half of the rows
    assert batch["caiac", "swapped"].any()
    online = made.make_online_buffer(made.rows()).sample()
    assert set(online.keys(True)) == set(batch.keys(True))
    assert ("hindsight", "relabeled") not in online.keys(True)
    cfg.learner.successful = 0.7
    with pytest.raises(ValueError, match=r"successful is 0.7, but .* set it to null"):
        steps.parts.make_learner(cfg, "none")


def test_rewards_are_ogbenchs_success():
    generator = torch.Generator().manual_seed(0)
    desired = torch.randn(500, 6, generator=generator)
    achieved = desired + torch.randn(500, 6, generator=generator) * 0.2
    offsets = (achieved - desired).view(500, 2, 3) / 10
    expected = [
        0.0 if all(offset.square().sum().sqrt() <= 0.04 for offset in row) else -1.0
        for row in offsets
    ]
    found = ogbench_cube_reward(achieved, desired)
    assert found.tolist() == expected and 0.1 < -found.mean() < 0.9
    with pytest.raises(ValueError, match="positions"):
        ogbench_cube_reward(achieved[:, :4], desired[:, :4])


def test_ogbenchs_oracle_solves_tasks(steps, compose, tmp_path):
    cfg = compose("env=ogbench_cube_double_play", out=tmp_path)
    cfg = changed(cfg, evaluate={"tasks": [1, 5]})
    environment = steps.parts.make_environment(cfg)
    oracle = Oracle()
    episodes = environment.play(oracle, 0, tmp_path)
    assert [e["task"] for e in episodes] == ["task1"] * 2 + ["task5"] * 2
    assert all(e["success"] and 20 < e["steps"] < 500 for e in episodes)
    first = oracle.calls[0]
    assert "is_init" in first and "is_init" not in oracle.calls[1]
    assert first["observation"].dtype == first["desired_goal"].dtype == torch.float32
    assert environment.measures(episodes) == [
        {"task": f"task{i}", "measure": "success", "episodes": 2, "value": 1.0}
        for i in (1, 5)
    ]
    # These simulators have been used, and the outcome is that of new ones.
    cfg = changed(cfg, evaluate={"tasks": [1]})
    for again in (environment, steps.parts.make_environment(cfg)):
        again.settings.evaluate.tasks = [1]
        assert again.play(Oracle(), 1, tmp_path) == episodes[:2]


def test_actions_beyond_the_bounds_are_clipped(steps, compose, tmp_path):
    cfg = compose("env=ogbench_cube_double_play", out=tmp_path)
    cfg = changed(cfg, evaluate={"tasks": [1]})
    environment = steps.parts.make_environment(cfg)
    assert all(e["success"] for e in environment.play(Oracle(scale=10), 0, tmp_path))


def test_episodes_that_reach_no_goal_end(steps, compose, tmp_path):
    cfg = compose("env=ogbench_cube_double_play", out=tmp_path)
    cfg = changed(cfg, evaluate={"tasks": [3], "episodes": 1})
    environment = steps.parts.make_environment(cfg)
    (episode,) = environment.play(Still(most=-1), 0, tmp_path)
    expected = {"task": "task3", "episode": 0, "success": False, "steps": 500}
    assert episode == {**expected, "goals": "all"}
    assert environment.measures([episode])[0]["value"] == 0.0


def test_one_goal_is_told_at_a_time(steps):
    from environments.one_goal import OneGoal

    layout = ready_layout("ogbench/cube-double")
    told = []

    def actor(td):
        told.append(td["desired_goal"].clone())
        return TensorDict({"action": torch.zeros(len(td), 5)}, td.batch_size)

    policy = OneGoal(actor, layout, tolerance=0.4)
    state = torch.zeros(4, 37)
    goals = torch.zeros(4, 6)
    goals[0] = torch.tensor([0.0, 0, 0, 2, 0, 0.0])  # the second cube's
    goals[1] = torch.tensor([2.0, 0, 1, 0, 2, 0.5])  # the second one's is lower
    goals[2] = torch.tensor([2.0, 0, 0, 0, 2, 0.0])  # the first one's, of equal ones
    goals[3] = torch.tensor([0.3, 0, 0, 0, 0.3, 0.0])  # both are reached
    td = TensorDict({"observation": state, "desired_goal": goals}, [4])
    out = policy(td)
    assert torch.equal(td["desired_goal"], goals) and out["action"].shape == (4, 5)
    expected = goals.clone()
    expected[1, :3] = 0
    expected[2, 3:] = 0
    assert torch.equal(told[0], expected)
    # Cubes have moved: that goal stays until it is reached.
    state[1, 19:22] = state[1, 28:31] = torch.tensor([1.0, 1, 0])
    state[2, 19:22] = goals[2, :3]
    policy(td.update(out["next"]))
    assert told[1][1].tolist() == [1, 1, 0, 0, 2, 0.5]
    assert told[1][2].tolist() == goals[2].tolist()


def test_a_goal_is_chosen_after_all_were_reached(steps):
    from environments.one_goal import OneGoal

    told = []

    def actor(td):
        told.append(td["desired_goal"].tolist()[0])
        return TensorDict({}, td.batch_size)

    policy = OneGoal(actor, ready_layout("ogbench/cube-double"), tolerance=0.4)
    goals = torch.tensor([[0.0, 0, 1, 0, 0, 0]])
    state = torch.zeros(1, 37)
    state[0, 21] = 1.0
    td = TensorDict({"observation": state, "desired_goal": goals}, [1])
    carried = policy(td)["next"]
    state[0, 19] = state[0, 28] = 2.0  # both have moved; the second one's is lower
    policy(td.update(carried))
    assert told == [[0, 0, 1, 0, 0, 0], [2, 0, 1, 0, 0, 0]]
    with pytest.raises(ValueError, match=r"env.evaluate.goals=\[all\]"):
        OneGoal(actor, ready_layout("ogbench/scene"), tolerance=0.4)


def test_a_random_policy_plays_the_same_whichever_goals_are_listed(
    steps, compose, tmp_path
):
    class Random(Still):
        def __call__(self, td):
            self.seen.append(torch.randn(1))
            return super().__call__(td)

    first = []
    for kinds in (["one"], ["all", "one"]):
        cfg = compose("env=ogbench_cube_double_play", out=tmp_path)
        cfg = changed(cfg, evaluate={"tasks": [1], "episodes": 1, "goals": kinds})
        actor = Random(most=-1)
        steps.parts.make_environment(cfg).play(actor, 0, tmp_path)
        first.append([actor.seen[0], actor.seen[-2 * 500]])
    assert len({float(x) for pair in first for x in pair}) == 1


def test_tasks_are_played_with_one_goal_too(steps, compose, tmp_path):
    cfg = compose("env=ogbench_cube_double_play", out=tmp_path)
    cfg = changed(cfg, evaluate={"tasks": [5], "goals": ["all", "one"]})
    environment = steps.parts.make_environment(cfg)
    oracle = Oracle()
    episodes = environment.play(oracle, 0, tmp_path)
    assert [e["goals"] for e in episodes] == ["all"] * 2 + ["one"] * 2
    assert all(e["success"] for e in episodes)
    assert environment.measures(episodes) == [
        {"task": "task5", "measure": measure, "episodes": 2, "value": 1.0}
        for measure in ("success", "success, one goal at a time")
    ]


def test_starts_depend_on_the_split_alone(steps, compose, tmp_path):
    cfg = compose("env=ogbench_cube_double_play", out=tmp_path)
    environment = steps.parts.make_environment(cfg)
    test, again = (starts(environment, "test") for _ in range(2))
    assert torch.equal(test["observation"], again["observation"])
    assert torch.equal(test["desired_goal"], again["desired_goal"])
    validation = starts(environment, "validation")
    assert len(test) == 10 and len(validation) == 5
    cubes = [row["observation"][19:].numpy() for row in (*test, *validation)]
    distances = [
        np.abs(one - other).max() for i, one in enumerate(cubes) for other in cubes[:i]
    ]
    assert min(distances) > 1e-3
    # The goals of task 1, in either order of the cubes.
    goals = (10 * test["desired_goal"][:2]).round().tolist()
    assert all(goal in ([0, 0, 2, 0, 10, 2], [0, 10, 2, 0, 0, 2]) for goal in goals)


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"validation_seed": 1_000_009}, "change validation_seed"),
        ({"tasks": [0, 1]}, r"expected some of 1 to 5"),
        ({"tasks": []}, r"expected some of 1 to 5"),
    ],
)
def test_wrong_settings_of_the_evaluation(wrong, match, steps, compose, tmp_path):
    cfg = compose("env=ogbench_cube_double_play", out=tmp_path)
    environment = steps.parts.make_environment(changed(cfg, evaluate=wrong))
    with pytest.raises(ValueError, match=match):
        environment.check()
    with pytest.raises(ValueError, match=match):
        environment.play(Still(), 0, tmp_path)
    with pytest.raises(ValueError, match="split is 'train'"):
        environment.play(Still(), 0, tmp_path, split="train")


@pytest.mark.parametrize(
    ("scene", "goals", "match"),
    [
        ("cube-double", [], r"goals is \[\], expected a list of some of"),
        ("cube-double", ["all", "all"], "each once"),
        ("cube-double", ["two"], r"a list of some of \['all', 'one'\]"),
        ("cube-double", "one", "goals is 'one', expected a list"),
        ("cube-double", None, "goals is None, expected a list"),
        ("scene", ["all", "one"], r"only goals of cubes .* scene is scene: use \[all"),
    ],
)
def test_wrong_goals_are_refused_before_anything_else(
    scene, goals, match, steps, compose, tmp_path
):
    cfg = compose("env=ogbench_cube_double_play", out=tmp_path)
    cfg = changed(cfg, scene=scene)
    cfg.env.evaluate.goals = goals
    with pytest.raises(ValueError, match=match):
        steps.parts.make_environment(cfg)


def test_methods_score_the_rows(steps, cfg):
    steps.fit.fit(cfg)
    steps.score.score(cfg)
    rows = steps.parts.make_environment(cfg).rows()
    for key in (("motion", "score"), ("distance", "action")):
        scores = rows[key]
        assert scores.shape == (80, 3) and 0 < (scores[:, 1:] > 0.5).sum() < 160


def test_the_distance_of_a_scene_is_to_its_handles(steps, compose, tmp_path):
    cfg = compose("env=ogbench_scene", out=tmp_path)
    steps.collect.collect(cfg)
    environment = steps.parts.make_environment(cfg)
    rows = environment.held_out()
    found = environment.distance_rule(action_only=True)(rows)
    env = make_ogbench_env("scene")
    env.reset(seed=0)
    model, data = env.unwrapped.model, env.unwrapped.data
    sites = ["btntop_0", "btntop_1", "drawer_handle_center", "window_handle_center"]
    for row, scores in zip(rows, found, strict=True):
        data.qpos[:] = row["info", "qpos"].numpy()
        mujoco.mj_forward(model, data)
        places = [data.joint("object_joint_0").qpos[:3]]
        places += [data.site(site).xpos for site in sites]
        hand = data.site("ur5e/robotiq/pinch").xpos
        near = [bool(np.linalg.norm(place - hand) <= 0.05) for place in places]
        assert scores[1:].bool().tolist() == near
    env.close()
    truth = environment.ground_truth()
    assert truth.shape == (len(rows), 6) and truth[:, 0].all()
