"""Which state is chosen: by what is left out; that the choice says what it saw; and that it can fail."""

from dataclasses import replace

import numpy as np
import pytest
from crossings import crossings
from drawings import frechet, path_from

from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import Imitation, ImitationError, ImitationSettings, fit
from dt_viz.learning.preparation import prepare
from dt_viz.learning.state import learn
from dt_viz.learning.store import FitStore

S = np.linspace(0, 1, 150)[:, None]


def into_a_channel(num, seed=0):
    """Motions of one field of places: from starts far apart into a wavy channel, and along it to the goal."""
    found = []
    for x, off in np.random.default_rng(seed).uniform((0.15, -0.08), (0.45, 0.08), (num, 2)):
        along = x * (1 - S)
        wave = 0.08 * np.sin(12 * along)
        found.append(Demonstration(3 * S[:, 0], np.hstack([along, wave + off * (along / 0.45) ** 3]), f"{x:.2f}"))
    return found


def of_a_hand(num, seed=0):
    """Motions in space as a hand guides them: starts 2 cm apart, slow waves of 2 cm that no start tells of."""
    rng, found = np.random.default_rng(seed), []
    for k in range(num):
        path = np.hstack([0.4 * (1 - S), 0.15 * np.sin(np.pi * S), 0.1 * S * (1 - S)])
        waves = sum(rng.normal(scale=0.02, size=3) / rate * np.sin(rate * np.pi * S) for rate in (1, 2, 3))
        found.append(Demonstration(3 * S[:, 0], path + waves + (1 - S) * rng.normal(scale=0.02, size=3), f"{k}"))
    return found


def off(imitation, motions):
    """Mean Fréchet distance of what is predicted for the starts of motions from these."""
    return np.mean([frechet(path_from(imitation, m.positions[0]), m.positions) for m in motions])


class Plain:
    """Fits in the plain state, and counts them."""

    def __init__(self, demonstrations):
        self.demonstrations, self.settings = demonstrations, []

    def __call__(self, settings, progress):
        self.settings.append(settings)
        return fit(self.demonstrations, settings, progress)


def path_from_plain(imitation: Imitation, start):
    """The same of a plain motion."""
    z = imitation.base.at_fraction(imitation.transform.forward(start[None]), np.linspace(1, 0, 400))
    return imitation.transform.inverse(z)[0]


@pytest.mark.long
def test_a_field_of_places_is_learned_in_the_plain_state():
    shown, new = into_a_channel(7), into_a_channel(5, seed=1)
    chosen = learn(shown)
    assert chosen.state == "plain" and not chosen.reason
    assert isinstance(chosen, Imitation) and chosen.choice and chosen.choice.num == 7
    assert chosen.choice.plain < 0.7 * chosen.choice.augmented < 0.7 * chosen.choice.shifted_mean
    plain = np.mean([frechet(path_from_plain(chosen, m.positions[0]), m.positions) for m in new])
    assert plain < off(learn(shown, state="augmented"), new)


@pytest.mark.long
def test_what_a_hand_guides_is_learned_in_the_augmented_state_although_the_plain_one_draws_it():
    shown, new = of_a_hand(6), of_a_hand(20, seed=1)
    plain, chosen, motions = learn(shown, state="plain"), learn(shown), prepare(shown)
    assert motions.missed_by(plain.system, motions.starts) < ImitationSettings().max_missed
    assert chosen.state == "augmented" and chosen.choice and chosen.choice.plain > 1.25 * chosen.choice.augmented
    assert isinstance(plain, Imitation)
    plainly = np.mean([frechet(path_from_plain(plain, m.positions[0]), m.positions) for m in new])
    mean = np.mean([m.positions for m in shown], axis=0)
    trivially = np.mean([frechet(mean + (1 - S) * (m.positions[0] - mean[0]), m.positions) for m in new])
    assert off(chosen, new) < min(plainly / 1.2, 1.05 * trivially)


def test_what_crosses_is_learned_in_the_augmented_state_without_a_plain_fit_to_all():
    demonstrations = crossings()["wide eight"].demonstrations
    plain = Plain(demonstrations)
    chosen = learn(demonstrations, plain=plain)
    assert chosen.state == "augmented" and "nearer to what it has not learned from" in chosen.reason
    assert plain.settings == []


def test_what_both_would_have_given_is_said():
    chosen = learn(of_a_hand(6))
    assert chosen.choice
    plain, augmented = (f"{1e3 * one:.1f} mm" for one in (chosen.choice.plain, chosen.choice.augmented))
    assert plain in str(chosen.choice) and augmented in str(chosen.choice) and str(chosen.choice) in chosen.reason
    assert learn(of_a_hand(6), state="augmented").choice is None


@pytest.mark.long
@pytest.mark.parametrize("num", [1, 2])
def test_of_one_or_two_none_is_left_out(num):
    chosen = learn(into_a_channel(num))
    assert chosen.state == "plain" and chosen.choice is None
    crossing = learn(crossings()["wide eight"].demonstrations[:num])
    assert crossing.state == "augmented" and "misses a demonstration" in crossing.reason


@pytest.mark.long
def test_a_plain_fit_that_misses_is_not_taken():
    demonstrations = into_a_channel(7)
    coarse = fit(demonstrations[:6])
    taken = learn(demonstrations, plain=lambda _settings, _progress: coarse)  # not a fit of all of these, but near
    assert isinstance(taken, Imitation) and taken.transform is coarse.transform

    elsewhere = fit([replace(d, positions=d.positions * [1.0, -1.0]) for d in demonstrations])
    missing = learn(demonstrations, plain=lambda _settings, _progress: elsewhere)
    assert missing.state == "augmented" and "of the extent" in missing.reason

    def fail(_settings, _progress):
        raise ImitationError("no map")

    failing = learn(demonstrations, plain=fail)
    assert failing.state == "augmented" and "no map" in failing.reason


@pytest.mark.long
@pytest.mark.parametrize(
    "poor", [ImitationSettings(num_layers=1, regularisation=1.0), ImitationSettings(objective="velocity")]
)
def test_settings_of_the_plain_fit_do_not_change_the_state(poor):
    fits, demonstrations = FitStore(None), tuple(into_a_channel(6))
    assert fits.learned(demonstrations, poor).state == "plain"
    assert fits.learned(tuple(of_a_hand(5)), poor).state == "augmented"


@pytest.mark.long
def test_progress_grows_and_ends_at_the_whole():
    for demonstrations in (into_a_channel(4), of_a_hand(4)):
        reports = []
        learn(demonstrations, progress=lambda done, message: reports.append((done, message)))  # noqa: B023
        done = [fraction for fraction, _ in reports]
        assert done == sorted(done) and done[-1] == 1.0 and any("left out" in message for _, message in reports)


def test_who_cancels_while_some_are_left_out_is_heard():
    def cancel(_done, message):
        if "left out" in message:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learn(of_a_hand(3), progress=cancel)


def test_scatter_without_gaps_is_one_pattern_and_two_ways_are_two():
    for seed in range(5):
        noisy = of_a_hand(9, seed)
        imitation = learn(
            [replace(d, positions=3 * d.positions - 2 * noisy[0].positions) for d in noisy], state="augmented"
        )
        assert imitation.known_labels == ()
    ways = crossings()["left and right from one start"].demonstrations
    assert learn([w for w in ways for _ in range(3)], state="augmented").known_labels == (-1.0, 1.0)
