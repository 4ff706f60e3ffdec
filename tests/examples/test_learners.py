"""Tests of the learners, on small random data."""

from __future__ import annotations

import json
import math
import re
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from tensordict import TensorDict
from tensordict.nn import InteractionType, TensorDictModule
from tensordict.nn.probabilistic import interaction_type
from torchrl.data import TensorStorage

EXAMPLES = Path(__file__).parents[2] / "examples"
EPISODES, STEPS = 12, 15
ENVIRONMENTS = ("fetch_push", "kitchen")
LEARNERS = ("bc", "diffusion_bc", "td3", "td3_bc", "iql", "lmp")


@pytest.fixture(scope="module")
def modules(steps):
    """The modules of the learners, imported as the scripts do."""
    import environments.fetch_push
    import environments.kitchen
    import learners.chunks
    import learners.hindsight

    return SimpleNamespace(
        environments={
            "fetch_push": environments.fetch_push.FetchPush,
            "kitchen": environments.kitchen.Kitchen,
        },
        fetch_push=environments.fetch_push,
        chunks=learners.chunks,
        hindsight=learners.hindsight,
    )


def make_rows(environment) -> TensorDict:
    """Trajectories with random states and motion scores; half of them succeed."""
    torch.manual_seed(0)
    layout, rows = environment.layout, EPISODES * STEPS
    states = torch.randn(EPISODES, STEPS + 1, sum(layout.widths().values())).mul(0.1)
    last = torch.arange(STEPS) == STEPS - 1
    data = TensorDict(
        {
            "observation": states[:, :-1].flatten(0, 1),
            "action": torch.rand(rows, environment.action_dim) * 2 - 1,
            "episode": torch.arange(EPISODES).repeat_interleave(STEPS),
            ("motion", "score"): (torch.rand(rows, len(layout)) < 0.3).float(),
            "next": {
                "observation": states[:, 1:].flatten(0, 1),
                "done": last.repeat(EPISODES)[:, None],
                "terminated": torch.zeros(rows, 1, dtype=torch.bool),
            },
        },
        [rows],
    )
    achieved = layout.achieved_goal(data, next=True).unflatten(0, (EPISODES, STEPS))
    goals = achieved[:, 10:11].clone()
    goals[::2] += 1.0
    goals = goals.expand_as(achieved)
    data["desired_goal"] = goals.flatten(0, 1)
    reward = environment.reward_fn(achieved.flatten(0, 1), data["desired_goal"])
    data["next", "reward"] = reward.reshape(-1, 1)
    return data


@pytest.fixture
def configure(modules, compose, tmp_path, monkeypatch):
    """Returns the small configuration of a learner on random data."""

    def configured(environment, learner, *overrides, method="motion"):
        kind = modules.environments[environment]
        rows = make_rows(kind)
        for name in ("rows", "goal_rows", "demonstrations"):
            monkeypatch.setattr(kind, name, lambda self: rows.clone())
        names = (f"env={environment}", f"learner={learner}", f"method=[{method}]")
        cfg = compose(*names, out=tmp_path)
        return OmegaConf.merge(cfg, OmegaConf.from_dotlist(list(overrides)))

    return configured


def make(steps, cfg, seed=0):
    """Returns a learner after its setup."""
    (method,) = cfg.method
    learner = steps.parts.make_learner(cfg, method)
    learner.setup(learner.rows(), seed)
    return learner


@pytest.mark.parametrize(
    ("environment", "learner", "method"),
    [
        *product(ENVIRONMENTS, LEARNERS, ["motion"]),
        *[("fetch_push", learner, "none") for learner in ("bc", "td3_bc")],
    ],
)
def test_an_interrupted_run_ends_as_one_that_was_not(
    environment, learner, method, configure, steps, monkeypatch
):
    cfg = configure(environment, learner, method=method)
    whole = steps.train.train(cfg, method, 1)
    state = whole.policy_state()
    assert all(isinstance(value, torch.Tensor) for value in state.values())
    assert all(value.isfinite().all() for value in state.values())
    folder = steps.parts.run_folder(cfg, method, 1)
    folder.rename(folder.with_name("whole"))
    take_step = type(whole).step

    def interrupted(self, batch, step):
        if step == 9:
            raise KeyboardInterrupt
        return take_step(self, batch, step)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(type(whole), "step", interrupted)
        steps.train.train(cfg, method, 1)
    resumed = steps.train.train(cfg, method, 1).policy_state()
    assert resumed.keys() == state.keys()
    changed = False
    start = make(steps, cfg, 1).policy_state()
    for key, value in state.items():
        assert torch.equal(resumed[key], value), key
        changed |= not torch.equal(start[key], value)
    assert changed
    # Without setup, the saved policy is the trained one.
    loaded = steps.train.load_policy(cfg, method, 1, 12).state_dict()
    prefix = "model." if learner == "lmp" else ""
    for key, value in state.items():
        assert torch.equal(loaded[prefix + key], value), key


@pytest.mark.parametrize("learner", LEARNERS)
def test_policies_play(learner, modules, configure, steps):
    cfg = configure("fetch_push", learner)
    made = make(steps, cfg)
    actor = made.load_policy(made.policy_state())
    torch.manual_seed(0)
    episodes = modules.fetch_push.play(actor, episodes=2, steps=11, seed=0)
    assert len(episodes) == 2 and not any(e["full"] for e in episodes)


def test_cloning_against_a_plain_loop(configure, steps):
    """The same weights as a loop over single rows with torch alone."""
    cfg = configure("fetch_push", "bc", "learner.batch_size=16")
    learner = make(steps, cfg)
    features = learner.make_features()
    features.load_state_dict(learner.actor.features.state_dict())
    layers = [m for m in learner.actor.network if hasattr(m, "weight")]
    weights = [
        p.detach().clone().requires_grad_() for m in layers for p in m.parameters()
    ]
    moments = [(torch.zeros_like(w), torch.zeros_like(w)) for w in weights]
    stream = learner.batches()
    for step in range(1, 7):
        batch = next(stream)
        total = torch.zeros(())
        for row in batch.unbind(0):
            value = features(row.select("observation", "desired_goal"))["features"]
            for k in range(0, len(weights), 2):
                value = weights[k] @ value + weights[k + 1]
                if k + 2 < len(weights):
                    value = value.clamp_min(0)
            total = total + (value.tanh() - row["action"]).square().mean() / 16
        gradients = torch.autograd.grad(total, weights)
        lr = 1e-3 * 0.5 * (1 + math.cos(math.pi * (step - 1) / cfg.learner.steps))
        for weight, (m, v), g in zip(weights, moments, gradients, strict=True):
            m.mul_(0.9).add_(0.1 * g)
            v.mul_(0.999).add_(0.001 * g * g)
            weight.data.mul_(1 - lr * cfg.learner.weight_decay)
            size = (v / (1 - 0.999**step)).sqrt() + 1e-8
            weight.data.sub_(lr * m / (1 - 0.9**step) / size)
        scalars = learner.step(batch, step)
        torch.testing.assert_close(scalars["loss_bc"], total.detach())
    trained = [p for m in layers for p in m.parameters()]
    for weight, parameter in zip(weights, trained, strict=True):
        torch.testing.assert_close(parameter, weight, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("learner", ["bc", "diffusion_bc"])
def test_goals_follow_the_swap(learner, configure, steps):
    """A swapped cube has a goal of its donor's episode, the others that of the row."""
    half = "env.augmentation.counterfactual_ratio=0.5"
    cfg = configure("fetch_push", learner, "learner.batch_size=64", half)
    made = make(steps, cfg)
    layout, rows = made.environment.layout, made.rows()
    batch = next(made.batches())
    swapped = batch["caiac", "swapped"]
    assert swapped[32:].any() and not swapped[:32].any()
    own = [
        ((rows["action"] - row["action"]).abs().sum(-1) < 1e-6).nonzero().item()
        for row in batch.unbind(0)
    ]
    moved = 0
    for n, name in enumerate(layout.names):
        if name in layout.fixed:
            assert not swapped[:, n].any()
            continue
        columns, goal = list(layout.columns[name]), list(layout.goal[name])
        for i, row in enumerate(batch.unbind(0)):
            same = (rows["observation"][:, columns] == row["observation"][columns]).all(
                -1
            )
            source = same.nonzero().item()
            # A row that was drawn twice may be its own donor.
            assert bool(swapped[i, n]) or source == own[i]
            moved += source != own[i]
            assert torch.equal(
                rows["desired_goal"][source, goal], row["desired_goal"][goal]
            )
    assert moved > 0


def test_goals_of_the_future(configure, steps):
    cfg = configure(
        "kitchen", "bc", "learner.goals=future", "learner.batch_size=64", method="none"
    )
    cfg.learner.future_goals = {"uniform": 1.0}
    made = make(steps, cfg)
    rows = made.rows()
    assert "desired_goal" not in rows
    achieved = made.environment.layout.achieved_goal(rows, next=True)
    offsets = []
    for batch, _ in zip(made.batches(), range(8), strict=False):
        for row in batch.unbind(0):
            own = (rows["action"] == row["action"]).all(-1).nonzero().item()
            goal = (achieved == row["desired_goal"]).all(-1).nonzero().item()
            assert rows["episode"][own] == rows["episode"][goal]
            offsets.append(goal - own)
    assert min(offsets) >= 0 and max(offsets) > STEPS // 2


def test_wrong_goals_are_refused(configure, steps, monkeypatch):
    cfg = configure("fetch_push", "bc", "learner.goals=other")
    with pytest.raises(ValueError, match=r"goals is 'other', .* 'own' or 'future'"):
        make(steps, cfg)
    cfg = configure("fetch_push", "bc")
    rows = make_rows(type(steps.parts.make_environment(cfg)))
    kind = type(steps.parts.make_environment(cfg))
    monkeypatch.setattr(kind, "demonstrations", lambda _: rows.exclude("desired_goal"))
    with pytest.raises(
        KeyError, match=r"lack \['desired_goal'\].*learner.goals=future"
    ):
        make(steps, cfg)


def test_chunks_are_the_actions_of_windows(configure, steps):
    cfg = configure("fetch_push", "diffusion_bc", "learner.batch_size=64")
    made = make(steps, cfg)
    rows, size = made.rows(), made.window
    for row in next(made.batches()).unbind(0):
        first = (rows["action"] == row["action"]).all(-1).nonzero().item()
        assert rows["episode"][first] == rows["episode"][first + size - 1]
        expected = rows["action"][first : first + size].flatten()
        assert torch.equal(row["chunk"], expected)


@given(
    st.lists(st.lists(st.booleans(), min_size=1, max_size=6), min_size=1, max_size=5)
)
@settings(deadline=None, max_examples=50)
def test_rows_until_success(modules, episodes):
    rows = TensorDict(
        {
            "episode": torch.tensor([n for n, e in enumerate(episodes) for _ in e]),
            ("next", "reward"): torch.tensor([[s - 1.0] for e in episodes for s in e]),
        }
    ).auto_batch_size_(1)
    expected = [
        any(episode) and not any(episode[:step])
        for episode in episodes
        for step in range(len(episode))
    ]
    assert modules.hindsight.until_success(rows).tolist() == expected
    # Interleaved: the first rows of all episodes, then the second ones, ...
    steps = torch.tensor([step for e in episodes for step in range(len(e))])
    mixed = steps.argsort(stable=True)
    found = modules.hindsight.until_success(rows[mixed])
    assert found.tolist() == torch.tensor(expected)[mixed].tolist()


def test_a_share_of_rows_is_of_successful_episodes(modules):
    part = torch.arange(1000) < 100
    sampler = modules.hindsight.ShareSampler(part, 0.7)
    storage = TensorStorage(TensorDict({"a": torch.arange(1000)}, [1000]))
    torch.manual_seed(0)
    index, _ = sampler.sample(storage, 20_000)
    # 0.7, and a tenth of the other 0.3.
    assert part[index].float().mean().item() == pytest.approx(0.73, abs=0.02)
    assert len(index[part[index]].unique()) == 100
    assert len(index.unique()) > 990
    with pytest.raises(ValueError, match=r"no row .*successful is 0.7"):
        modules.hindsight.ShareSampler(torch.zeros(5, dtype=torch.bool), 0.7)


def test_actions_that_do_not_explain_the_goal_are_not_cloned(configure, steps):
    cfg = configure("fetch_push", "td3_bc", "learner.batch_size=64")
    made = make(steps, cfg)
    batch = next(made.batches())
    stored = batch["not_cloned"].clone()
    assert stored.any() and not stored.all()
    seen = []
    loss = made.loss_module.actor_loss
    made.loss_module.actor_loss = lambda b: (seen.append(b["not_cloned"]), loss(b))[1]
    made.step(batch, 1)
    flags, moved = batch["caiac", "counterfactual"], batch["hindsight", "relabeled"]
    assert (flags & moved & ~stored).any() and (flags & ~moved & ~stored).any()
    assert torch.equal(seen[0], stored | (flags & moved))


def test_all_of_play_is_cloned(configure, steps, modules, monkeypatch):
    options = ("learner.batch_size=64", "learner.successful=null")
    cfg = configure("kitchen", "td3_bc", *options)
    assert make(steps, cfg).rows()["not_cloned"].any()
    kind = modules.environments["kitchen"]
    monkeypatch.setattr(kind, "episodes_have_goals", False)
    assert not make(steps, cfg).rows()["not_cloned"].any()


def test_goals_of_other_rows_are_not_cloned_without_augmentation(configure, steps):
    """A share of the goals is random then (A.5.2): no action explains them either."""
    options = ("learner.batch_size=64", "env.augmentation.counterfactual_ratio=0.8")
    made = make(steps, configure("fetch_push", "td3_bc", *options, method="none"))
    batch = next(made.batches())
    stored, moved = batch["not_cloned"].clone(), batch["hindsight", "relabeled"]
    made.step(batch, 1)
    new = batch["not_cloned"] & ~stored
    assert new.any() and not (new & ~moved).any()
    # Of the rows, 0.4 have random goals and 0.5 those of their future.
    assert 0.25 < new[~stored].float().mean().item() < 0.55


@pytest.mark.parametrize("learner", ["td3", "td3_bc", "iql"])
def test_targets_have_no_gradient(learner, configure, steps):
    """The loss of the action values has no gradient but for the values themselves."""
    made = make(steps, configure("fetch_push", learner))
    batch = next(made.batches())
    batch["next", "desired_goal"] = batch["desired_goal"]
    loss = made.loss_module
    compute = loss.qvalue_loss if learner == "iql" else loss.value_loss
    compute(batch)[0].backward()
    with_gradient = {
        name.split("_params")[0]
        for name, parameter in loss.named_parameters()
        if parameter.grad is not None and parameter.grad.any()
    }
    assert with_gradient == {"qvalue_network"}


@pytest.mark.parametrize("method", ["motion", "none"])
def test_no_goals_of_other_rows(method, configure, steps):
    """Only real rows are relabelled, with goals of their own future."""
    cfg = configure("fetch_push", "iql", "learner.batch_size=64", method=method)
    made = make(steps, cfg)
    batch = next(made.batches())
    moved = batch["hindsight", "relabeled"]
    flags = batch.get(("caiac", "counterfactual"), torch.zeros_like(moved))
    assert moved.any() and not (moved & flags).any()
    rows = made.rows()
    achieved = made.environment.layout.achieved_goal(rows, next=True)
    for row in batch[moved.squeeze(-1)].unbind(0):
        own = (rows["action"] == row["action"]).all(-1).nonzero().item()
        goal = (achieved == row["desired_goal"]).all(-1).nonzero().item()
        assert rows["episode"][own] == rows["episode"][goal] and goal >= own


@pytest.mark.parametrize("goals", ["null", "{uniform: 1.0}"])
def test_values_need_rewards(goals, configure, steps, monkeypatch):
    cfg = configure("fetch_push", "iql", f"learner.future_goals={goals}")
    kind = type(steps.parts.make_environment(cfg))
    monkeypatch.setattr(kind, "reward_fn", None)
    with pytest.raises(ValueError, match="learner=iql needs rewards for goals"):
        make(steps, cfg)


def test_the_learning_rate_of_iql_falls_and_its_policy_has_own_sizes(configure, steps):
    options = ["learner.decay_steps=6", "learner.steps=6", "learner.policy_sizes=[24]"]
    made = make(steps, configure("fetch_push", "iql", *options))
    rates, batches = [], made.batches()
    for step in range(1, 7):
        made.step(next(batches), step)
        rates.append(made.optimizer.param_groups[0]["lr"])
    # One step remains after each of them.
    expected = [0.5e-3 * (1 + math.cos(math.pi * step / 6)) for step in range(1, 7)]
    assert rates == pytest.approx(expected, abs=1e-12)
    assert "scheduler" in made.parts
    policy = made.load_policy(made.policy_state())
    widths = [x.shape[0] for n, x in policy.network.state_dict().items() if "bias" in n]
    assert widths == [24, 4]
    with pytest.raises(ValueError, match=r"decay_steps is 6, expected .* at least 8"):
        made.check(2)


@pytest.mark.parametrize(
    ("learner", "option", "match"),
    [
        ("iql", "decay_steps=7", "learner.decay_steps is 7, expected .* at least 8"),
        ("iql", "decay_steps=.nan", "learner.decay_steps is nan"),
        ("iql", "decay_steps=1e5", "learner.decay_steps is 100000.0"),
        ("iql", "decay_steps=soon", "learner.decay_steps is 'soon'"),
        ("iql", f"temperature=1{'0' * 400}", "learner.temperature is 1000"),
        ("iql", "deviation=0", "learner.deviation is 0, but it should be greater than"),
        ("iql", "gamma=1", "learner.gamma is 1, but it should be less than 1"),
        ("iql", "tau=.nan", "learner.tau is nan"),
        ("iql", "random_goals=maybe", "learner.random_goals is 'maybe'"),
        ("td3_bc", "successful=2", "learner.successful is 2"),
        ("td3_bc", "bc_alpha=null", "learner.bc_alpha is None"),
        ("td3", "policy_delay=0", "learner.policy_delay is 0"),
        ("td3", "noise_clip=-1", "learner.noise_clip is -1"),
        ("td3", "hidden_dtype=float16", "is 'float16', .* 'auto', 'float32' or"),
        ("bc", "steps=0", "learner.steps is 0"),
        ("bc", "steps=1e5", "learner.steps is 100000.0, but it should be a valid int"),
        ("bc", "steps=null lr=-1", "learner.steps is None.*; learner.lr is -1"),
        ("bc", "batches_at_once=1.5", "learner.batches_at_once is 1.5"),
        ("bc", "batch_size=true", "learner.batch_size is True"),
        ("bc", "checkpoint_every=7", "learner.checkpoint_every is 7, .* multiple of"),
        ("bc", "keep_every=9", "keep_every is 9, .* at most learner.steps, 8"),
        ("bc", "log_every=0", "learner.log_every is 0"),
        ("bc", "logger=print", "learner.logger is 'print', .* 'csv', 'tensorboard' or"),
        ("bc", "goals=their", "learner.goals is 'their', .* 'own' or 'future'"),
        ("bc", "lr=.inf", "learner.lr is inf, but it should be a finite number"),
        ("bc", "weight_decay=-1", "learner.weight_decay is -1"),
        ("diffusion_bc", "execute=5", "learner.execute is 5, .* learner.chunk, 4"),
        ("diffusion_bc", "beta_end=1", "learner.beta_end is 1"),
        ("diffusion_bc", "hidden_sizes=[8]", "learner.hidden_sizes is .* at least 2"),
        ("lmp", "goals=last", "learner.goals is 'last'"),
        ("lmp", "goals={last: -1}", "learner.goals is .* 'last' .* got -1"),
        ("lmp", "goal_p=2", "learner.goal_p is 2"),
        ("td3", "hidden_sizes=[8,0]", r"is \[8, 0\], but element 1: it should be"),
        ("bc", "future_goals=last", "learner.future_goals is 'last'"),
        ("lmp", "decoder=open", "learner.decoder is 'open'"),
        ("lmp", "kl_weight=.nan", "learner.kl_weight is nan"),
        ("iql", "temperature=-1", "learner.temperature is -1"),
        ("iql", "temperature=null", "learner.temperature is None"),
        ("iql", "expectile=1", "learner.expectile is 1"),
        ("iql", "policy_sizes=[]", r"learner.policy_sizes is \[\]"),
        ("iql", "policy_sizes=16", "learner.policy_sizes is 16"),
        ("td3", "hidden_sizes=[true]", r"learner.hidden_sizes is \[True\]"),
        ("iql", "future_goals=uniform", "learner.future_goals is 'uniform'"),
        ("iql", "future_goals={p: 0.3}", "without geometric offsets p has no effect"),
        ("iql", "future_goals={geometric: 1.0, p: null}", "future_goals .* got None"),
        ("iql", "future_goals={uniform: 1.0}", "learner.successful .* has no effect"),
        (
            "iql",
            "future_goals={uniform: 1.0} successful=null random_goals=true",
            "learner.random_goals is True, but has no effect .* set it to false",
        ),
        ("bc", "future_goals={first: 1.0} goals=future", "future_goals .* strategies"),
    ],
)
def test_wrong_settings_are_refused_before_anything_is_written(
    learner, option, match, configure, steps
):
    options = ["learner.steps=8", "learner.checkpoint_every=4"]
    options += [f"learner.{part}" for part in re.split(r" (?=\w+=)", option)]
    cfg = configure("fetch_push", learner, *options)
    with pytest.raises(ValueError, match=match):
        steps.train.train(cfg, "motion", 0)
    assert not steps.parts.run_folder(cfg, "motion", 0).exists()


@pytest.mark.parametrize(
    ("option", "match"),
    [
        ("counterfactual_ratio=2", "env.augmentation.counterfactual_ratio is 2"),
        ("swap_prob=often", "env.augmentation.swap_prob is 'often'"),
        ("lookahead=-1", "lookahead is -1, but it should be .* 0, or it should be 'ne"),
        ("lookahead=goal", "lookahead is 'goal', but learner=td3 draws no goals"),
    ],
)
@pytest.mark.parametrize("method", ["motion", "none"])
def test_settings_of_the_augmentation(option, match, method, configure, steps):
    cfg = configure("fetch_push", "td3", f"env.augmentation.{option}", method=method)
    if option == "lookahead=goal" and method == "none":
        steps.parts.check_learner(cfg, method)  # without effect
        return
    with pytest.raises(ValueError, match=match):
        steps.train.train(cfg, method, 0)
    assert not steps.parts.run_folder(cfg, method, 0).exists()


def test_policies_to_validate(configure, steps):
    for option in ("validation.policies=0", "validation=null", "validation=5"):
        cfg = configure("fetch_push", "td3", option)
        with pytest.raises(ValueError, match="validation"):
            steps.parts.check_learner(cfg, "motion")


@pytest.mark.parametrize(
    ("env", "learner", "option", "match"),
    [
        ("fetch_push", "td3", "env.evaluate.episodes=0", "env.evaluate.episodes is 0"),
        ("fetch_push", "td3", "env.evaluate.validation_episodes=0", "episodes is 0"),
        ("fetch_push", "bc", "env.demonstrations=null", "demonstrations is null"),
        ("fetch_push", "lmp", "env.demonstrations=null", "demonstrations is null"),
        ("fetch_push_sliding", "bc", "out=unused", "demonstrations is null"),
        ("kitchen", "bc", "learner.goals=own", "Kitchen have no goals of their own"),
        ("kitchen", "bc", "env.evaluate.tasks=[kettl]", r"tasks is \['kettl'\]"),
        ("kitchen", "bc", "env.evaluate.tasks=[]", r"tasks is \[\], expected some"),
        ("kitchen", "bc", "env.evaluate.validation_seed=5", "raise env.evaluate"),
        (
            "fetch_push",
            "bc",
            "env.evaluate.validation_seed=1000050",
            "also some of the",
        ),
        ("fetch_push", "bc", "env.evaluate=3", "env.evaluate is 3, .* a group"),
        ("kitchen", "bc", "env.evaluate.seed=null", "integer of at least 0"),
        ("kitchen", "bc", "~env.evaluate.seed", "env.evaluate.seed is missing"),
        ("fetch_push", "bc", "env.augmentation.threshold=auto", "threshold is 'auto'"),
    ],
)
def test_settings_of_the_environment(env, learner, option, match, compose, steps):
    cfg = compose(f"env={env}", f"learner={learner}", "method=[motion]", option)
    with pytest.raises(ValueError, match=match):
        steps.parts.check_learner(cfg, "motion")


@pytest.mark.parametrize("learner", ["bc", "td3"])
def test_settings_that_may_be_missing(learner, compose, steps):
    missing = "~env.augmentation.counterfactual_ratio"
    cfg = compose(f"learner={learner}", "env=fetch_push", "method=[none]", missing)
    steps.parts.check_learner(cfg, "none")
    if learner == "bc":
        cfg.learner.future_goals = None  # which goals of its own do not read
        steps.parts.check_learner(cfg, "none")


def test_a_method_that_refuses_its_threshold(configure, steps):
    cfg = configure("fetch_push", "td3", "method.caiac.threshold=-1", method="caiac")
    with pytest.raises(ValueError, match=r"env.augmentation, or the method: threshold"):
        steps.parts.check_learner(cfg, "caiac")


def test_goals_of_hindsight_are_checked_first(configure, steps):
    cfg = configure("fetch_push", "td3")
    OmegaConf.update(cfg, "env.augmentation.hindsight", {"future": 2}, force_add=True)
    with pytest.raises(ValueError, match=r"hindsight is .*: future must be in"):
        steps.parts.check_learner(cfg, "motion")


def test_a_run_that_cannot_begin_keeps_no_settings(configure, steps, monkeypatch):
    """Scores that are missing are scored; the run is then the first one."""
    cfg = configure("fetch_push", "bc")
    kind = type(steps.parts.make_environment(cfg))
    rows = kind.demonstrations(None)
    with monkeypatch.context() as context:
        context.setattr(kind, "demonstrations", lambda self: rows.exclude("motion"))
        with pytest.raises(KeyError, match="score the data first"):
            steps.train.train(cfg, "motion", 0)
    assert not steps.parts.run_folder(cfg, "motion", 0).exists()
    steps.train.train(cfg, "motion", 0)


def test_the_settings_of_all_studies_are_right(steps):
    for path in sorted((EXAMPLES / "conf" / "study").glob("*.yaml")):
        for study in (found := steps.studies.load_study(path.stem)), found.quick():
            for run in study.runs():
                steps.parts.check_learner(run.cfg, run.method)


@pytest.mark.parametrize("learner", ["bc", "lmp"])
def test_weights_of_goals_replace_the_default_ones(learner, compose):
    name = "goals" if learner == "lmp" else "future_goals"
    cfg = compose(f"learner={learner}", f"learner.{name}={{uniform: 1.0}}")
    assert cfg.learner[name] == {"uniform": 1.0}


def test_future_goals_need_no_stored_ones(configure, steps, monkeypatch):
    options = ["learner.future_goals={uniform: 1.0}", "learner.successful=null"]
    cfg = configure("fetch_push", "iql", *options)
    kind = type(steps.parts.make_environment(cfg))
    rows = kind.goal_rows(None).exclude("desired_goal")
    monkeypatch.setattr(kind, "goal_rows", lambda self: rows.clone())
    made = make(steps, cfg)
    assert "desired_goal" in next(made.batches())


def test_rewards_of_future_goals_are_checked(configure, steps, monkeypatch):
    options = ["learner.future_goals={uniform: 1.0}", "learner.successful=null"]
    cfg = configure("fetch_push", "iql", *options)
    made = steps.parts.make_learner(cfg, "motion")
    rb = made.make_buffer(made.rows())
    assert (rb.sample()["next", "reward"].shape) == (made.rows_at_once, 1)
    kind = type(made.environment)
    monkeypatch.setattr(kind, "reward_fn", staticmethod(lambda new, goals: new[:, :2]))
    rb = made.make_buffer(made.rows())
    with pytest.raises(ValueError, match="reward_fn returned"):
        rb.sample()


class TestChunkActor:
    """Chunks that count: the first value of the input, plus 0, 0.1, ... ."""

    @pytest.fixture
    def actor(self, modules):
        self.calls = []

        def plan(start):
            self.calls.append(len(start))
            return start + torch.arange(4) / 10

        policy = TensorDictModule(plan, ["observation"], ["chunk"])
        return modules.chunks.ChunkActor(policy, size=4, execute=3, action_dim=1)

    def test_actions(self, actor):
        """The first three of four actions, then a new chunk."""
        carried = TensorDict({"is_init": torch.ones(2, 1, dtype=torch.bool)}, [2])
        actions = []
        for step in range(5):
            observation = torch.tensor([[0.0], [-1.0]]) + 0.01 * step
            td = actor(TensorDict({"observation": observation}, [2]).update(carried))
            actions.append(td["action"])
            carried = td["next"]
            if step == 1:  # the second one starts again
                carried["is_init"] = torch.tensor([[False], [True]])
        actions = torch.stack(actions)[..., 0]
        torch.testing.assert_close(
            actions[:, 0], torch.tensor([0, 0.1, 0.2, 0.03, 0.13])
        )
        expected = torch.tensor([-1, -0.9, -0.98, -0.88, -0.78])
        torch.testing.assert_close(actions[:, 1], expected)
        assert self.calls == [2, 1, 1]

    @pytest.mark.parametrize("sample", [True, False])
    def test_random_chunks(self, modules, sample):
        def plan(start):
            random = interaction_type() is InteractionType.RANDOM
            return torch.rand(len(start), 4) if random else torch.zeros(len(start), 4)

        policy = TensorDictModule(plan, ["observation"], ["chunk"])
        actor = modules.chunks.ChunkActor(
            policy, size=4, execute=1, action_dim=1, sample=sample
        )
        td = TensorDict({"observation": torch.zeros(2, 1)}, [2])
        td["is_init"] = torch.ones(2, 1, dtype=torch.bool)
        assert bool(actor(td)["action"].any()) == sample

    def test_a_lost_chunk_is_refused(self, actor):
        td = TensorDict({"observation": torch.zeros(2, 1)}, [2])
        with pytest.raises(KeyError, match="make_tensordict_primer"):
            actor(td)
        td["is_init"] = torch.tensor([[True], [False]])
        with pytest.raises(KeyError, match="make_tensordict_primer"):
            actor(td)

    def test_more_actions_than_in_a_chunk(self, modules, actor):
        with pytest.raises(ValueError, match="execute is 5, expected 1 to 4"):
            modules.chunks.ChunkActor(actor.policy, size=4, execute=5, action_dim=1)


@pytest.mark.parametrize("first", ["float32", "bfloat16"])
def test_the_faster_dtype_is_that_of_the_first_run(
    first, configure, steps, new_process
):
    """Wherever others of the same folder train or resume."""
    other = "bfloat16" if first == "float32" else "float32"
    cfg = configure("fetch_push", "td3", "learner.hidden_dtype=auto")
    new_process(first)
    steps.train.train(cfg, "motion", 0)
    new_process(other)
    learner = steps.train.train(cfg, "motion", 1)
    assert learner.settings.hidden_dtype == first
    assert cfg.learner.hidden_dtype == "auto"
    for seed in (0, 1):
        folder = steps.parts.run_folder(cfg, "motion", seed)
        kept = json.loads((folder / "train.json").read_text())
        assert kept["hidden_dtype"] == first
    layers = [m for m in learner.actor.modules() if getattr(m, "relu", False)]
    dtype = None if first == "float32" else torch.bfloat16
    assert {layer.compute_dtype for layer in layers} == {dtype}
    steps.train.load_policy(cfg, "motion", 0, cfg.learner.steps)
