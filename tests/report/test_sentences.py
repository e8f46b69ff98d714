"""Sentences say how large the gap is, then why, then what is left, and are never more sure than the numbers."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from jaxfinger.gap.result import Key
from jaxfinger.report import sentences
from jaxfinger.report.names import key_name, site_names

from .fabricated import COUPLED, EXCURSION, LARGE, LINES, SMALL, every, explained

ALL = every()
SIZE = "The model misses the joint torque by 1.2 N mm in 30 N mm (4 %, ID.4) and the tendon excursion by 6 µm in 20 mm"
SAYS = {
    "no_gap": ("No gap beyond the noise", ["predicts both channels", "within the noise", "97 %"]),
    "tolerated": ("No gap beyond your tolerance", ["6 µm in 20 mm (0.03 %", "within your tolerance of 2 %"]),
    "explained": (
        "Explained: tendon stretch at T3",
        [
            SIZE,
            "almost certainly causes 96 % of it (95 % interval 94 to 98 %)",
            "every channel comes down to its noise",
        ],
    ),
    "two": (
        "Explained: tendon stretch at T3 and joint Stribeck at PIP",
        [SIZE, "very probably tendon stretch at T3 (52 % of it) and joint Stribeck at PIP (41 %)", "with them"],
    ),
    "coupled": ("Explained: moment arm coupling at T1, T2, T3, T4 and T5", [SIZE, "97 % of it"]),
    "partly": (
        "Partly explained: tendon stretch at T3 and joint Stribeck at PIP; 30 % is left",
        [SIZE, "What is left, 30 % of the gap (20 to 40 %), lies mostly in joint torque PIP of ID.4", "tension"],
    ),
    "partly_ambiguous": (
        "Partly explained: joint Stribeck at PIP; 55 % is left",
        [SIZE, "(95 % interval 35 to 47 %); these trials cannot tell tendon stretch at T3 from tendon creep at T3."],
    ),
    "still_open": (
        "Partly explained: tendon stretch at T3; 3 % is left",
        ["what stays open on trials that no fit has seen is tendon excursion of VD.1 (1.6 times its noise)."],
    ),
    "ambiguous": (
        "Cannot be told apart yet: tendon stretch at T3 or tendon creep at T3",
        [SIZE, "cannot tell tendon stretch at T3 from tendon creep at T3", "62 %", "MCP at 23° and PIP from 6° to 57°"],
    ),
    "unexplained": (
        "Unexplained by any known cause",
        [SIZE, "None of the known causes explains it: it lies mostly in"],
    ),
    "not_judged": ("Nothing could be judged", ["says nothing about the gap", "record it with holds"]),
    "some_not_judged": (
        "Explained: tendon stretch at T3",
        [SIZE, "Not judged: joint torque of ID.4 and joint torque of ID.3-static."],
    ),
    "diverged": ("Explained: tendon stretch at T3", [SIZE, "VD.3 diverges, so that its angles close nothing"]),
    "against": (
        "Explained: a change of damping at MCP",
        ["The model of A-fit.json misses", "Damping MCP was 12.0 ± 2.0 N mm s/rad and is 16.00 ± 0.98 N mm s/rad"],
    ),
    "first_look": ("Explained: tendon stretch at T3", ["At a first look the model misses"]),
}


def test_a_model_that_misses_by_more_than_the_noise_is_not_said_to_predict_to_within_it():
    """A gap that nothing smooth and no cause explains, as of noisy accelerations, is named with its size."""
    nothing = ALL["no_gap"]
    line = replace(nothing.closures[0], after=9.0 * nothing.closures[0].noise)
    said = sentences.summary(replace(nothing, closures=(line, *nothing.closures[1:])))
    assert "within the noise" not in said
    assert "leaves in both channels that could be judged nothing that a law could explain" in said
    assert f"larger than the channel's own noise in joint torque of {line.experiment} (9 times)" in said
    assert "as where noise of angles or of accelerations moves a prediction" in said


@pytest.mark.parametrize(("trials", "alone"), [(("a",), True), (("a", "b"), False)])
def test_a_lone_trial_whose_parts_predict_each_other_badly_is_to_be_repeated(trials, alone):
    """Its held-out parts say nothing of noise."""
    nothing = ALL["no_gap"]
    line = replace(nothing.closures[0], after=9.0 * nothing.closures[0].noise)
    stacks = {line.experiment: SimpleNamespace(trials=trials)}
    found = replace(nothing, closures=(line,))
    object.__setattr__(found, "problem", SimpleNamespace(stacks=stacks, simulator=None))  # all that a summary reads
    said = sentences.summary(found)
    assert ("as where a trial stands alone" in said) == alone
    assert ("as where noise of angles" in said) != alone


@pytest.mark.parametrize("name", ALL)
def test_headline_and_summary(name):
    headline, parts = SAYS[name]
    assert sentences.headline(ALL[name]) == headline
    text = sentences.summary(ALL[name])
    for part in parts:
        assert part in text
    assert "_" not in text
    assert "nan" not in text.lower()
    extra = name in ("some_not_judged", "diverged", "against")
    assert 2 <= text.count(". ") + 1 <= 3 + extra
    assert all(s[0].isupper() for s in text.split(". "))


def test_what_matters_leads_whatever_comes_first_in_the_file():
    d = replace(explained(), relevance=(replace(LARGE, tolerated=True), SMALL), tolerance={"joint_torque": 0.05})
    text = sentences.size(d)
    assert text.index("6 µm") < text.index("1.2 N mm")
    assert "within your tolerance of 5 %" in text


def test_traces_that_no_channel_shows_alone_are_said():
    """A probability of one half for «nothing» would leave the reader to guess what the other half is."""
    text = sentences.summary(replace(ALL["no_gap"], none=0.5, unlisted=0.5))
    assert "traces of something more" in text
    assert "50 %" not in text


def test_what_noise_also_gives_is_no_gap_in_the_world():
    d = replace(ALL["no_gap"], relevance=(SMALL,))
    assert sentences.headline(d) == "No gap beyond the noise"
    assert "misses" not in sentences.summary(d)


def test_a_tolerated_gap_of_unknown_cause_is_not_said_to_be_nothing():
    text = sentences.summary(replace(ALL["tolerated"], none=0.01))
    assert "within your tolerance" in text
    assert "probability" not in text


def test_another_simulator_is_told_which_of_its_parameters_are_off():
    (x,) = ALL["against"].changes
    says = "Damping MCP is 12 N mm s/rad in the simulator, and 16.00 ± 0.98 N mm s/rad by the measurements."
    assert sentences.contradicted(x) == says
    assert sentences.retuned((x,)).endswith(
        "retuned, most of all damping MCP, 12 N mm s/rad to 16.00 ± 0.98 N mm s/rad"
    )
    assert "agree" in sentences.retuned(())


@pytest.mark.parametrize("gap", [True, False])
def test_a_retuned_simulator_that_predicts_unseen_trials_worse_is_said_to(gap):
    d, worse = ALL["unexplained"], replace(LINES[0], before=5.66e-4, after=9.48e-4, closed=-1.0, closed_ci95=(-1, -1))
    d = replace(d, changes=ALL["against"].changes, closures=(worse,), relevance=d.relevance if gap else ())
    object.__setattr__(d, "problem", SimpleNamespace(simulator=True))  # all that a summary reads
    text = sentences.summary(d)
    assert text.count("joint torque of ID.4 (0.95 instead of 0.57 N mm)") == 1
    assert ("predicted worse with these parameters" in text) == gap
    assert ("The retuned simulator predicts trials that no fit has seen worse than before" in text) == (not gap)


def test_a_signal_of_nothing_has_no_relative_size():
    d = replace(explained(), relevance=(replace(LARGE, signal=0.0, relative=0.0),))
    assert sentences.size(d) == "the model misses the joint torque by 1.2 N mm (ID.4)"


def test_a_cause_that_held_out_trials_do_not_show_is_not_said_to_cause_nothing():
    d = explained()
    hidden = replace(d, budget=(replace(d.budget[0], share=0.0, share_ci95=(0.0, 0.36)),))
    text = sentences.summary(hidden)
    assert "is almost certainly at work, but closes 0 % of it (95 % interval 0 to 36 %) on trials that no fit" in text


def test_where_channels_disagree_their_shares_stand_in_place_of_the_interval():
    d = explained()
    disagreeing = replace(d.budget[0], share=0.5, channels={EXCURSION: 0.98})  # the second channel: nothing
    text = sentences.summary(replace(d, budget=(disagreeing,)))
    says = "causes 50 % of it (0 % in tendon excursion of VD.1, 98 % in tendon excursion of ID.4);"
    assert says in text
    third = replace(d.channels[0], experiment="ID.2")
    text = sentences.summary(replace(d, budget=(disagreeing,), channels=(*d.channels, third)))
    assert "(from 0 % in tendon excursion of VD.1 to 98 % in tendon excursion of ID.4)" in text


@pytest.mark.parametrize(("share", "doubted"), [(0.1, False), (0.4, True)])
def test_where_much_is_left_the_cause_that_is_named_is_doubted(share, doubted):
    d = ALL["partly"]
    text = sentences.summary(replace(d, unexplained=replace(d.unexplained, share=share)))
    assert ("may only imitate a law that nobody listed" in text) == doubted


def test_a_gap_that_shows_in_no_channel_alone_has_a_cause_and_no_share():
    text = sentences.summary(replace(explained(), relevance=()))
    assert text.startswith("All trials together show that the model misses something")
    assert "Tendon stretch at T3 is almost certainly at work; with it" in text
    assert "%" not in text


@pytest.mark.parametrize(("chance", "word"), [(0.55, "probably"), (0.93, "very probably"), (0.995, "almost certainly")])
def test_words_of_certainty_follow_the_probability(chance, word):
    d = explained()
    d = replace(d, budget=(replace(d.budget[0], probability=chance),))
    assert f"tendon stretch at T3 {word} causes".lower() in sentences.summary(d).lower()


def test_a_long_list_of_causes_is_cut_and_counted():
    causes = tuple(replace(COUPLED, effect=f"effect_{c}", sites=((f"T{k}",),)) for k, c in enumerate("abcdef"))
    d = replace(explained(), budget=causes, named=tuple(Key(c.effect, c.sites[0]) for c in causes))
    assert sentences.headline(d).endswith("effect d at T3, and 2 more causes")


def test_a_long_list_of_open_channels_counts_channels():
    d = every()["still_open"]
    lines = tuple(replace(d.closures[1], experiment=e) for e in ("VD.1", "VD.2", "VD.3", "ID.2", "ID.4", "ID.3-static"))
    assert "and 2 more channels" in sentences.summary(replace(d, closures=lines))


def test_sites_of_two_words_are_said_as_words():
    drifts = Key("torque_sensor_drift", ("torque_sensor",))
    assert key_name(drifts) == "torque sensor drift at torque sensor"
    assert key_name(Key("channel_delay", ("tendon_force",))) == "channel delay at tendon force"
    assert site_names([("my_joint", "PIP")]) == "my_joint-PIP"  # a user's own name stays as it is


def test_simulated_angles_do_not_count_as_predicted_to_within_the_noise():
    """They miss many times the spread between repeats, also where nothing is wrong."""
    angle = replace(LINES[2], noise=0.001, before=0.05, after=0.05)
    d = replace(ALL["no_gap"], closures=(*ALL["no_gap"].closures, angle))
    assert "predicts both channels that could be judged" in sentences.summary(d)


def test_causes_that_make_unseen_trials_worse_may_only_imitate_another_law():
    """In one channel they close the gap, and in another they open one, or the model is extrapolated."""
    worse = replace(LINES[0], before=6.08e-4, after=6.24e-4, closed=-0.07, closed_ci95=(-0.12, -0.01))
    text = sentences.summary(replace(ALL["partly"], closures=(worse, *LINES[1:])))
    assert (
        ". But trials that no fit has seen are predicted worse with what is named, joint torque of ID.4 (0.62 instead "
        "of 0.61 N mm): it may only imitate a law that nobody listed" in text
    )
    unsure = replace(worse, closed_ci95=(-0.12, 0.01))
    assert "predicted worse" not in sentences.summary(replace(ALL["partly"], closures=(unsure, *LINES[1:])))
    assert "predicted worse" not in sentences.summary(ALL["partly"])


def test_a_rest_of_nothing_is_not_given_as_what_makes_the_diagnosis_partial():
    none_left = replace(ALL["partly"].unexplained, share=0.0, share_ci95=(0.0, 0.49))
    traces = replace(ALL["partly"], unexplained=none_left, closures=LINES, unlisted=0.9987)
    assert sentences.headline(traces).endswith("; something more leaves traces")
    text = sentences.summary(traces)
    assert "0 % of the gap" not in text
    assert "something that the catalogue lacks is almost certainly at work: its trace lies mostly in" in text
    stays = replace(ALL["still_open"], unexplained=none_left)
    assert sentences.headline(stays).endswith("; tendon excursion of VD.1 stays open")
    assert "What stays open on trials that no fit has seen is tendon excursion of VD.1" in sentences.summary(stays)
    assert "is left" not in sentences.summary(stays)
    both = replace(stays, closures=tuple(replace(x, after=2.0 * x.noise) for x in LINES[:2]))
    assert sentences.headline(both).endswith("; 2 channels stay open")
    rivals = replace(ALL["partly_ambiguous"], unexplained=none_left)
    assert sentences.headline(rivals).endswith("; other causes cannot be told apart")
    assert "Hardly anything of the gap is left." in sentences.summary(rivals)


@pytest.mark.parametrize("share", [0.1, 0.44])
def test_a_large_rest_of_a_small_gap_is_said_where_every_channel_comes_down_to_its_noise(share):
    d = explained()
    text = sentences.summary(replace(d, unexplained=replace(d.unexplained, share=share, share_ci95=(0.3, 0.5))))
    says = "What is left, 44 % of the gap (30 to 50 %), is within the error of the noise's own estimate."
    assert (says in text) == (share > 0.25)
