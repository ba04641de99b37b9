"""`carom reproduce TABLE`: train what a table of the paper needs, measure, and write the table."""

import concurrent.futures
import dataclasses
import multiprocessing
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro
from rich.console import Console

from carom.checks import require

Choice = Literal["s1", "s2", "s3", "s4", "s5", "s6", "s7", "s8", "s9", "s10", "properties", "figure3", "all", "page"]
MINUTES = {"bp5-e": 1.5, "bp5": 1.5, "bd5": 4, "cp3-e": 0.7, "cp3": 0.7, "gyro-e": 1, "gyro": 1.2, "rope": 2}
"""What a training takes on two cores, about, where none like it was measured yet; other tasks longer."""


@dataclasses.dataclass(frozen=True)
class Reproduce:
    """Learn what a table of the paper's supplement needs, measure it, and write results/TABLE.json and TABLE.md.

    s1 to s10 are the tables S.1 to S.10 of the supplement; properties and figure3 are of contact properties and of the
    paper's figure 3; all is every one of these. page trains nothing: it writes the page of results (--page) and its
    pictures from the tables that are there (--results).

    Finished trainings, and those that the written table has already, are skipped; stopped ones go on.
    """

    table: Annotated[
        Choice,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="|".join(get_args(Choice)), help="Which table; or page, the page of all tables."),
    ]
    seeds: int = 3
    """Trainings of each kind, with seeds 0, 1, ..."""
    runs: Path = Path("runs/reproduce")
    """Folder of the trainings."""
    results: Path = Path("results")
    """Folder of the tables."""
    page: Path = Path("docs/results.md")
    """File that `carom reproduce page` writes."""
    workers: int = 1
    """Trainings at the same time, each a process."""
    only: str = ""
    """Only trainings whose name has this in it (cp3-e, chnn, seed0, ...); other cells stay as they are."""
    collect: bool = False
    """Train nothing: write the tables from the trainings that are finished."""
    quick: bool = False
    """A smoke run: the first two trainings of the table, few data and epochs; the numbers mean nothing."""

    def after_interrupt(self) -> str:
        """What to say when interrupted."""
        return "Finished trainings are kept: the same command goes on."

    def run(self) -> None:
        """Do it."""
        from carom.reproduction import pages
        from carom.reproduction.tables import BUILDERS, table

        console = Console()
        require(self.seeds >= 1, f"--seeds must be at least 1; it was {self.seeds}.")
        require(self.workers >= 1, f"--workers must be at least 1; it was {self.workers}.")
        if self.table == "page":
            from carom.atomic import check_writable, write_whole

            check_writable(self.page)
            write_whole(self.page, pages.page(self.results).encode())
            console.print(f"Written to {self.page}", soft_wrap=True, highlight=False)
            for path in pages.pictures(self.results, self.page.parent / "images"):
                console.print(f"Drawn: {path}", soft_wrap=True, highlight=False)
            return
        names: list[Any] = list(BUILDERS) if self.table == "all" else [self.table]
        every = {name: [job.name for job in table(name).jobs(self.seeds)] for name in names}
        wanted = [name for name in names if not every[name] or any(self.only in job for job in every[name])]
        require(
            any(self.only in job for name in names for job in every[name]),
            f"--only must be in the name of a training of {self.table}, e.g. {every[names[0]][0]}; it was "
            f"{self.only!r}.",
        )
        for name in wanted:
            self._one(name, console)

    def _one(self, name: Any, console: Console) -> None:
        from carom.reproduction import pages, results
        from carom.reproduction.jobs import Job
        from carom.reproduction.tables import table

        wanted = table(name)
        seeds, folder = (1, self.runs / "quick") if self.quick else (self.seeds, self.runs)
        every = wanted.jobs(seeds)
        jobs = [job for job in every if self.only in job.name]
        jobs = jobs[:2] if self.quick else jobs
        into = self.results / "quick" if self.quick else self.results
        earlier = results.written(name, into)
        known = {} if earlier is None else results.known(wanted, earlier, seeds, quick=self.quick)
        todo = [job for job in jobs if not (folder / job.name / "report.json").exists() and job not in known]
        todo = [] if self.collect else todo
        minutes = sum(_minutes(job, earlier) for job in todo) / self.workers
        console.print(
            f"{name}: {len(todo)} of {len(jobs)} trainings to do"
            + (f", about {minutes:.0f} minutes" if todo and not self.quick else ""),
            highlight=False,
        )
        # Finished trainings that are not asked for now stay in the table.
        finished = [job for job in every if (folder / job.name / "report.json").exists()]
        reports: dict[Job, Any] = {job: job.run(folder, quick=self.quick) for job in finished}

        def write() -> Path:
            content = results.collect(wanted, reports, seeds=seeds, quick=self.quick, earlier=earlier)
            return pages.write(content, into)

        def keep(job: Job, report: dict[str, Any]) -> None:
            reports[job] = report
            write()

        if self.workers == 1:
            for job in todo:
                keep(job, job.run(folder, quick=self.quick, say=lambda text: console.print(text, highlight=False)))
        else:
            self._parallel(todo, folder, keep, console)
        path = write().with_suffix(".md")
        if self.quick:
            console.print("A smoke run: the numbers mean nothing.")
        console.print(f"Written to {path}", soft_wrap=True, highlight=False)

    def _parallel(self, todo, folder: Path, keep, console: Console) -> None:
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(self.workers, mp_context=context) as pool:
            waiting = {pool.submit(_in_process, job, folder, self.quick): job for job in todo}
            for done in concurrent.futures.as_completed(waiting):
                keep(waiting[done], done.result())
                console.print(f"{waiting[done].name}: done ({len(waiting)} in all)", highlight=False)


def _minutes(job: Any, earlier: dict[str, Any] | None) -> float:
    """What a training takes, about: as long as those of other seeds that the written table has."""
    runs = {} if earlier is None else earlier["runs"]
    measured = [run["seconds"] / 60 for name, run in runs.items() if _seedless(name) == _seedless(job.name)]
    return sum(measured) / len(measured) if measured else MINUTES.get(job.task, 15.0)


def _seedless(name: str) -> str:
    return name.rpartition("-seed")[0]


def _in_process(job: Any, folder: Path, quick: bool) -> dict[str, Any]:
    from carom.cli.main import configure_jax

    configure_jax()
    return job.run(folder, quick=quick)
