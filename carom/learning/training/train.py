"""The trainer: one for every system and model. `learn` fits the unknowns of a skeleton to a dataset."""

import dataclasses
import itertools
import time
import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np

from carom.checks import require
from carom.contact.impulses import CMr
from carom.learning.config import FORMULATIONS, LearnConfig
from carom.learning.data_checks import check_dataset
from carom.learning.dataset import Chunks, Dataset, contact_flags
from carom.learning.estimation.refine import Fit, can_be_refined, polish
from carom.learning.estimation.state_shooting import Shot, estimate
from carom.learning.progress import LoopProgress, training_text
from carom.learning.run import RunFolder
from carom.learning.training.devices import from_first, own_devices
from carom.learning.training.loss import gather_chunks, train_step, validate
from carom.learning.training.optimizer import Rates, fresh_optimizer, learning_rate_schedule
from carom.learning.training.start import TrainState, fresh_state
from carom.learning.unknowns.baselines import physical_quantities
from carom.learning.unknowns.models import Unknowns, mass_ratios
from carom.recordings.recording import Recording
from carom.simulation.impact import Stepper
from carom.system import System


@dataclasses.dataclass(frozen=True)
class LearnReport:
    """What a training came to. `mass_ratio` is to the first body."""

    friction: list[float]
    restitution: list[float]
    mass_ratio: list[float]
    train_loss: float | None
    """None where no epoch was needed: the refinement before the first was enough."""
    val_loss: float
    epochs: int
    seconds: float
    stopped_early: bool
    skipped_steps: int
    overflowed_contacts: int
    refined: bool
    """Whether what was kept is what a refinement ended with (see `LearnConfig.refine`)."""
    starts_estimated: bool = False
    """Whether start states were estimated too, for data noisier than a step moves (`estimation/state_shooting.py`)."""
    epsilon: float | None = None
    """Of the contact model CMr."""


REFINE_AFTER = 0.4
"""Share of the epochs after which the unknowns are refined, potential included; again at the end.

If that is not enough, the network goes on learning with better masses, which it cannot tell from its own errors.
"""
EXACT = 0.01
"""A refinement ends that came to this share of what is enough."""
LOSS_WIDTH_DECAY = 1e-4
"""How narrow the quadratic part of the loss is at the end of a training, over its width at the start."""


def learn(
    skeleton: System,
    dataset: Dataset,
    config: LearnConfig | None = None,
    *,
    run: RunFolder | None = None,
    progress: bool = True,
) -> tuple[System, LearnReport]:
    """Learn the unknowns of `skeleton` from `dataset`: a System like it, with a neural potential and learned numbers.

    **Arguments:**

    - `skeleton`: bodies, constraints and contacts with their geometry. Its masses (but that of the first body, the
      unit of all), potential, friction and restitution are not used where `config.learn` names them.
    - `dataset`: training and validation recordings.
    - `config`: how; see `LearnConfig`.
    - `run`: a folder to keep metrics and checkpoints in. If it holds a checkpoint, the training goes on from there.
    - `progress`: show it.

    **Returns:** the learned system (of the best validation loss), and a report. Unless `config.refine` is off, steps of
    Gauss and Newton refine it on the way and at the end (see `estimation/refine.py`), if that validates better. Its
    potential has no network if the data need none.

    **Raises:** `CaromError` if data, skeleton and configuration do not fit, or the loss stays not finite.
    """
    config = LearnConfig() if config is None else config
    config.check()
    skeleton = config.prepare(skeleton)
    if config.refine and skeleton.friction.dtype == jnp.float32:
        warnings.warn(
            "the system is in single precision, in which nothing is refined. For double precision, call "
            'jax.config.update("jax_enable_x64", True) before it is made; refine=False silences this.',
            stacklevel=2,
        )
    return _Training(skeleton, dataset, config, run).go(progress)


class _Training:
    """One training: what is held while it goes on, and its state."""

    def __init__(self, skeleton: System, dataset: Dataset, config: LearnConfig, run: RunFolder | None):
        self.skeleton, self.dataset, self.config, self.run = skeleton, dataset, config, run
        most = check_dataset(skeleton, dataset, config)
        # Room for as many contacts as the data ever close at once, and two more for predictions that stray.
        self.trained = skeleton.with_max_active(most + 2) if skeleton.contacts else skeleton
        train = dataset.train
        self.chunks = Chunks.of(contact_flags(train, skeleton), train.length, config.states)
        smooth, impact = self.chunks.count()
        require(
            smooth + impact > 0, "the training data have no chunk that starts without contact: nothing to learn from."
        )
        self.state = fresh_state(skeleton, config, train)
        self.mesh = own_devices()
        restored = run.restore_checkpoint(self.state) if run is not None else None
        if run is not None and restored is not None:
            self.state = restored
            run.rewind_metrics(int(restored.epoch))
        elif run is not None:  # it may have been killed before its first checkpoint
            run.rewind_metrics(-1)
        self.state = from_first(self.state)
        self.resumed = bool(from_first(jnp.asarray(restored is not None)))
        self.stepper = Stepper(
            dt=jnp.asarray(train.dt),
            formulation=FORMULATIONS[config.model],
            project=config.project,
            compensation_steps=config.compensation_steps,
            consistent=True,
        )
        self.speed = float(np.sqrt(np.mean(train.v[train.valid] ** 2)))
        self.enough = config.enough * self.speed
        self.held_out = _validation_chunks(dataset.val, skeleton, config)
        before = run.metrics() if run is not None and self.resumed else []
        last = before[-1] if before else {}
        self.started = time.monotonic() - last.get("seconds", 0.0)
        loss = last.get("loss")  # null where it was not finite
        self.loss = np.nan if loss is None else float(loss)
        self.refines = config.refine and can_be_refined(self.state.unknowns, self.trained)
        self.refine_at = round(REFINE_AFTER * config.epochs)
        self.refinements = itertools.count(1)  # before the first epoch, for the log

    def go(self, progress: bool) -> tuple[System, LearnReport]:
        """Refine, learn for as many epochs as it takes, refine again: the learned system."""
        config, stopped, refined = self.config, False, False
        with LoopProgress("epoch", config.epochs, int(self.state.epoch), shown=progress) as self.shown:
            done = self.refines and not self.resumed and self.begin()
            fit = self.judge(self.state.best)
            while not done and int(self.state.epoch) < config.epochs:
                if (self.just_refined and fit.typical <= self.enough) or self.waited >= config.patience:
                    stopped = True
                    break
                fit = self.epoch(int(self.state.epoch) + 1, fit)
            best = self.state.best
            again = not (self.just_refined and int(self.state.epoch) == int(self.state.best_epoch))
            if self.refines and again and not done:
                better = self.refined(best, fit, whole=True)
                refined = better is not None
                best, fit = (best, fit) if better is None else better
            shot = _pruned(self.state.shot) if self.state.has_shot else None
            if shot is not None and not done:
                found = self.estimated(best, rival=shot)
                shot = None if found is None else found.unknowns  # what was learned since says that nothing is noisy
            if shot is not None:
                best, fit, refined = shot, self.judge(shot), True
        system = _pruned(best).assemble(self.skeleton)
        report = LearnReport(
            **quantities(system),
            train_loss=self.loss if int(self.state.epoch) else None,
            val_loss=fit.mean,
            epochs=int(self.state.epoch),
            seconds=time.monotonic() - self.started,
            stopped_early=stopped or done,
            skipped_steps=int(self.state.skipped),
            overflowed_contacts=int(self.state.overflow),
            refined=self.just_refined or refined,
            starts_estimated=shot is not None,
        )
        return system, report

    def begin(self) -> bool:
        """Refine the starting values; with noisy data, estimate start states too, and return whether that fits.

        Then it is the end; else training goes on from what was refined, and is resumed there.
        """
        fit = self.judge(self.state.unknowns)
        self.log(0, self.state.unknowns, refinement=0, val_loss=fit.mean)
        better = self.refined(self.state.unknowns, fit, whole=False)
        shot = self.estimated(self.state.unknowns if better is None else better[0])
        if shot is not None:
            number = next(self.refinements)
            self.log(0, shot.unknowns, refinement=number, val_loss=self.judge(shot.unknowns).mean)
            whole = _with_all_of(self.state.unknowns, shot.unknowns)
            self.state = dataclasses.replace(self.state, shot=whole, has_shot=jnp.asarray(True))
            if shot.fits:
                return True
        if better is not None:
            self.settle(better)
            self.state = from_first(_keep_best(self.state, better[1].mean, 0))
            if self.run is not None:
                self.run.save_checkpoint(0, self.state)
        return False

    @property
    def just_refined(self) -> bool:
        """Whether the best unknowns are what a refinement ended with."""
        return bool(self.state.settled) and int(self.state.best_epoch) in (0, self.refine_at)

    @property
    def waited(self) -> int:
        """Epochs without a better validation loss."""
        return int(self.state.epoch) - int(self.state.best_epoch)

    def judge(self, unknowns: Unknowns) -> Fit:
        """How well unknowns predict the chunks that are held out."""
        return Fit(*map(float, validate(unknowns, self.trained, *self.held_out, self.stepper)))

    def log(self, epoch: int, unknowns: Unknowns, **numbers: Any) -> dict[str, Any]:
        """An entry of the run's metrics."""
        metrics = {
            "epoch": epoch,
            "step": epoch * self.config.steps_per_epoch,
            "seconds": round(time.monotonic() - self.started, 3),
            **numbers,
            **quantities(unknowns.assemble(self.skeleton)),
            "skipped_steps": int(self.state.skipped),
            "overflowed_contacts": int(self.state.overflow),
        }
        if self.run is not None:
            self.run.log(metrics)
        return metrics

    def epoch(self, epoch: int, fit: Fit) -> Fit:
        """Learn from `chunks_per_epoch` chunks; returns how well the best unknowns fit, `fit` before."""
        config = self.config
        done = (epoch - 1) / config.epochs
        width = jnp.asarray(config.loss_width * self.speed * LOSS_WIDTH_DECAY**done, self.dataset.train.x.dtype)
        rate = learning_rate_schedule(config, config.epochs * config.steps_per_epoch)
        data = (self.trained, self.dataset.train, self.chunks)
        self.state, loss = _epoch(self.state, epoch, data, rate, self.stepper, width, config, self.mesh)
        self.loss = float(loss)
        now = self.judge(self.state.unknowns)
        if self.refines and epoch == self.refine_at:
            better = self.refined(self.state.unknowns, now, whole=True)
            if better is not None:
                now = better[1]
                self.settle(better)
        if now.mean < float(self.state.best_loss):
            fit = now
        self.state = _keep_best(self.state, now.mean, epoch)
        learning_rate = float(np.asarray(rate(epoch * config.steps_per_epoch)))
        metrics = self.log(epoch, self.state.unknowns, loss=self.loss, val_loss=now.mean, learning_rate=learning_rate)
        due = epoch % config.checkpoint_every == 0 or epoch in (self.refine_at, config.epochs)
        if self.run is not None and due:
            self.run.save_checkpoint(epoch, self.state)
        self.shown.update(epoch, training_text(metrics))
        require(
            np.isfinite(self.loss) or epoch < 3 or not np.isinf(float(self.state.best_loss)),
            f"the training loss is not finite ({int(self.state.skipped)} steps left out). Check the data, or lower "
            "learning_rate.",
        )
        return fit

    def settle(self, better: tuple[Unknowns, Fit]) -> None:
        """Go on from what was refined."""
        optimizer = fresh_optimizer(better[0], self.config)
        self.state = dataclasses.replace(self.state, unknowns=better[0], optimizer=optimizer, settled=jnp.asarray(True))

    def refined(self, unknowns: Unknowns, fit: Fit, *, whole: bool) -> tuple[Unknowns, Fit] | None:
        """Unknowns that validate better than these, and how well: of the simplest potential that is enough.

        `whole`: try the whole potential too. If not, this is the first time: each step is logged.
        """
        self.shown.say("refining ...")
        best, full = None, unknowns.potential

        def judge_step(new: Unknowns) -> Fit:
            found = self.judge(_with_all_of(unknowns, new))
            if not whole:
                self.log(0, new, refinement=next(self.refinements), val_loss=found.mean)
            return found

        for potential in ([] if full is None else full.simpler()) + ([full] if whole or full is None else []):
            start = dataclasses.replace(unknowns, potential=potential)
            new, found = polish(start, self.trained, self.stepper, self.dataset.train, judge_step, EXACT * self.enough)
            if found.mean < fit.mean:
                best, fit = (_with_all_of(unknowns, new), found), found
            if found.typical <= self.enough:
                break
        return best

    def estimated(self, unknowns: Unknowns, *, rival: Unknowns | None = None) -> Shot | None:
        """Unknowns estimated together with start states, if the data are so noisy that it is called for; or `rival`."""
        unknowns = _pruned(unknowns)
        number = itertools.count(1)

        def each() -> None:
            self.shown.say(f"noisy data: estimating start states too, step {next(number)} ...")

        data = (self.trained, self.stepper, self.dataset)
        return estimate(unknowns, *data, seed=self.config.seed, each=each, rival=rival)


def _validation_chunks(val: Recording, skeleton: System, config: LearnConfig):
    """A fixed draw of one batch of chunks, evenly from the validation trajectories."""
    rng = np.random.default_rng((config.seed, 1))
    chunks = Chunks.of(contact_flags(val, skeleton), val.length, config.states)
    require(sum(chunks.count()) > 0, "the validation data have no chunk that starts without contact.")
    trajectory, start = chunks.draw(rng, config.batch_size, config.contact_share)
    return gather_chunks(jnp.asarray(val.x), jnp.asarray(val.v), trajectory, start, config.states)


def _epoch(state: TrainState, epoch: int, data: tuple[System, Recording, Chunks], rate, stepper, width, config, mesh):
    """Learn from `chunks_per_epoch` new chunks. Their choice depends on seed and epoch alone, so that it can resume."""
    rng = np.random.default_rng((config.seed, 0, epoch))
    skeleton, train, chunks = data
    x, v = jnp.asarray(train.x), jnp.asarray(train.v)
    unknowns, opt_state = state.unknowns, state.optimizer
    losses, overflow, skipped = [], state.overflow, state.skipped
    drawn = chunks.draw(rng, config.chunks_per_epoch, config.contact_share)
    done = (epoch - 1) * config.steps_per_epoch
    for count, first in enumerate(range(0, config.chunks_per_epoch, config.batch_size)):
        trajectory, start = (part[first : first + config.batch_size] for part in drawn)
        batch = (skeleton, x, v, jnp.asarray(trajectory), jnp.asarray(start))
        rates = Rates.of(config, rate(done + count), state.settled)
        unknowns, opt_state, loss, over, bad = train_step(
            batch, unknowns, opt_state, rates, stepper, config.states, width, mesh
        )
        losses.append(loss)
        overflow, skipped = overflow + over, skipped + bad.astype(skipped.dtype)
    state = dataclasses.replace(
        state, unknowns=unknowns, optimizer=opt_state, epoch=jnp.asarray(epoch), overflow=overflow, skipped=skipped
    )
    return state, jnp.mean(jnp.stack(losses))


def _with_all_of(full: Unknowns, unknowns: Unknowns) -> Unknowns:
    """The same unknowns, with all parameters that the potential of `full` has."""
    if full.potential is None or unknowns.potential is None:
        return unknowns
    return dataclasses.replace(unknowns, potential=unknowns.potential.extended(full.potential))


def _pruned(unknowns: Unknowns) -> Unknowns:
    """The same unknowns, without a network that makes no force."""
    if unknowns.potential is None:
        return unknowns
    return dataclasses.replace(unknowns, potential=unknowns.potential.pruned())


def _keep_best(state: TrainState, val_loss, epoch: int) -> TrainState:
    if not float(val_loss) < float(state.best_loss):
        return state
    return dataclasses.replace(
        state, best=state.unknowns, best_loss=jnp.asarray(val_loss), best_epoch=jnp.asarray(epoch)
    )


def quantities(system: System) -> dict[str, Any]:
    """The physical quantities of a system, for metrics and reports; epsilon too, of a contact model that has one.

    Empty lists for those a network replaces.
    """
    has = physical_quantities(system)
    out = {
        "friction": np.asarray(system.friction).tolist() if "friction" in has else [],
        "restitution": np.asarray(system.restitution).tolist() if "restitution" in has else [],
        "mass_ratio": mass_ratios(system).tolist() if "mass" in has else [],
    }
    if isinstance(system.contact_model, CMr):
        out["epsilon"] = float(system.contact_model.epsilon)
    return out
