"""The paper's tables: which trainings they need, how cells are judged, and what is written; no training but one."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.cli.main import main
from carom.cli.reproduce import MINUTES, _minutes
from carom.reproduction.jobs import Job
from carom.reproduction.pages import brief, markdown, page, pictures, write
from carom.reproduction.results import collect, known, mean_over_seeds, measured, written
from carom.reproduction.tables import BUILDERS, Cell, paper, table
from carom.tasks import noisy, task
from carom.tasks.pendulums import chain_angles, chain_state


def report_of(cell: Cell, value: float) -> dict:
    """A report of a job in which every quantity and error is `value`."""
    filled = {"friction": [value] * 40, "restitution": [value] * 40, "mass_ratio": [value] * 12}
    provenance = {"digest": "x", "seconds": 60.0, "carom": "0", "jax": "0"}
    errors = {name: {"trajectory_error": value, "bounded_error": 0.75} for name in ("cm", "lcp")}
    # Errors that grow, and are lost after 30 steps: a report has null there.
    rise = [value * k for k in range(31)] + [None] * 5
    half = [None if v is None else v / 2 for v in rise]
    curve = {name: {"mean": rise, "ci95": half, "median": rise} for name in CURVES}
    told = {name: [{"standard_error": value / 10}] * 40 for name in ("friction", "restitution")}
    return {
        "learned": filled,
        "evaluation": errors,
        "over_time": {"cm": curve, "lcp": curve},
        "identification": told,
        "provenance": provenance,
    }


CURVES = ("state", "energy")


PRINTED = {"s1": 16, "s2": 16, "s3": 16, "s4": 16, "s5": 12, "s6": 12, "s7": 16, "s8": 2, "s9": 40, "s10": 12}


@pytest.mark.parametrize("name", BUILDERS)
def test_every_printed_number_has_a_cell(name):
    wanted = table(name)
    printed = [cell for cell in wanted.cells if cell.paper is not None and "learned with" not in cell.row]
    assert len(printed) == PRINTED.get(name, 0)
    assert len({(cell.row, cell.column) for cell in wanted.cells}) == len(wanted.cells)
    for cell in wanted.cells:
        assert (cell.job is None) <= (cell.note != "")
        if cell.kind == "property" and cell.paper is not None:
            assert abs(cell.paper - cell.true) < 0.5
        if cell.job is not None:
            value = cell.read(report_of(cell, 0.25))
            assert value == 0.25
    jobs = wanted.jobs(2)
    assert len(jobs) == len(set(jobs)) == len({job.name for job in jobs})


def test_true_values_are_those_of_the_supplement():
    for name, columns in (("s1", [1, 1, 1, 1]), ("s2", [2, 6, 8, 10])):
        assert [cell.true for cell in table(name).cells[:4]] == pytest.approx(columns)
        assert paper()[name]["true"] == columns
    true = {cell.column: cell.true for cell in table("s3").cells}
    assert list(true.values()) == pytest.approx([2.0, 1.5, 0.65, 0.75])
    true = {cell.column: cell.true for cell in table("s4").cells}
    assert true["gyro mu"] == 0.1
    assert true["gyro e"] == 0.8


JOB = Job("cp3")


@pytest.mark.parametrize(
    ("true", "printed", "values", "verdict"),
    [
        (0.5, 0.53, [0.505, 0.495], "better"),  # errors of 0.005 do not cancel: 6 times better than 0.03
        (0.5, 0.53, [0.51, 0.53], "met"),
        (0.5, 0.53, [0.50, 0.60], "worse"),
        (0.0, 0.0, [5e-5], "better"),
        (0.0, 0.0, [2e-4], "worse"),
        (2.0, 2.002, [2.0005], "better"),  # relative: 2.5e-4 for 1e-3
        (0.5, 0.53, [float("nan")], "worse"),
        (0.5, 0.53, [None], "worse"),
        (0.5, None, [0.6], ""),
    ],
)
def test_cells_are_judged_by_their_errors(true, printed, values, verdict):
    cell = Cell("row", "column", "property", JOB, lambda report: None, true, printed)
    assert measured(cell, values)["verdict"] == verdict


def test_the_mean_and_its_interval():
    cell = Cell("row", "column", "error", JOB, lambda report: None, paper=4e-3)
    found = measured(cell, [1e-3, 2e-3, 3e-3])
    assert found["carom"] == pytest.approx(2e-3)
    assert found["ci95"] == pytest.approx(4.3027 * 1e-3 / np.sqrt(3), rel=1e-4)  # Student, 2 degrees of freedom
    assert found["ratio"] == pytest.approx(0.5)
    assert found["verdict"] == "met"


def test_what_a_written_table_has_stays(tmp_path):
    wanted = table("s6")
    cell = wanted.cells[0]
    assert cell.job is not None
    jobs = [dataclasses.replace(cell.job, seed=seed) for seed in range(3)]
    report = report_of(cell, 0.5)
    report["provenance"]["digest"] = jobs[0].digest()
    stale = report_of(cell, 0.6)  # of other settings: its digest is "x"
    earlier = collect(wanted, {jobs[0]: report, jobs[1]: stale}, seeds=3, quick=False)
    write(earlier, tmp_path)
    earlier = written("s6", tmp_path)
    assert earlier is not None
    assert list(known(wanted, earlier, 3, quick=False)) == [jobs[0]]
    assert known(wanted, earlier, 3, quick=True) == {}
    assert "(seed 0 alone)" not in markdown(earlier)
    assert "(seeds 0, 1)" in markdown(earlier)
    again = collect(wanted, {jobs[2]: report_of(cell, 0.8)}, seeds=3, quick=False, earlier=earlier)
    assert again["cells"][0]["carom"] == pytest.approx(0.65)
    assert list(again["cells"][0]["by_seed"]) == ["0", "2"]
    assert set(again["runs"]) == {jobs[0].name, jobs[2].name}
    # Asking for fewer seeds loses nothing.
    fewer = collect(wanted, {}, seeds=1, quick=False, earlier={**again, "runs": {**again["runs"], **of_today(jobs)}})
    assert list(fewer["cells"][0]["by_seed"]) == ["0", "2"]
    # A training that is there now counts, not what was written of it.
    anew = collect(wanted, {jobs[0]: report_of(cell, 0.7)}, seeds=3, quick=False, earlier=earlier)
    assert anew["cells"][0]["by_seed"]["0"]["value"] == 0.7


def of_today(jobs: list[Job]) -> dict:
    """Runs of these jobs, with the settings that they have now."""
    return {job.name: {"digest": job.digest(), "seconds": 1.0} for job in jobs}


def test_errors_over_time_that_were_written_stay():
    wanted = table("figure3")
    cell = wanted.cells[0]
    assert cell.job is not None
    jobs = [dataclasses.replace(cell.job, seed=seed) for seed in range(2)]
    earlier = collect(wanted, {jobs[0]: report_of(cell, 0.5)}, seeds=2, quick=False)
    earlier["runs"] = of_today(jobs[:1])
    del earlier["cells"][0]["by_seed"]["0"]["early"]  # measured before there was such a number
    both = collect(wanted, {jobs[1]: report_of(cell, 1.5)}, seeds=2, quick=False, earlier=earlier)
    (curve,) = both["over_time"]
    assert list(mean_over_seeds(curve, "state")["mean"][:3]) == [0.0, 1.0, 2.0]
    assert both["cells"][0]["carom"] == 1.0
    assert "early" not in both["cells"][0]  # of one of two seeds


def test_a_damaged_table_is_refused(tmp_path):
    assert written("s6", tmp_path) is None
    for text in ("{", "[]", "{}"):
        (tmp_path / "s6.json").write_text(text)
        with refused("s6.json is not a table that carom wrote"):
            written("s6", tmp_path)


def test_tables_are_written_with_what_is_there(tmp_path):
    wanted = table("s6")
    cell = wanted.cells[0]
    assert cell.job is not None
    job = dataclasses.replace(cell.job, seed=0)
    content = collect(wanted, {job: report_of(cell, 0.5)}, seeds=1, quick=False)
    assert content["summary"]["compared"] == 2  # both properties of one training
    assert [c["note"] for c in content["cells"]].count("not run yet") == 10
    assert content["runs"] == {"cp3-clnn-cm-seed0": {"digest": "x", "seconds": 60.0, "carom": "0", "jax": "0"}}
    path = write(content, tmp_path / "results")
    assert json.loads(path.read_text())["cells"][0]["carom"] == 0.5
    text = path.with_suffix(".md").read_text()
    assert text == markdown(content)
    assert "| 0 | cp3 mu | 0.5 | 0.5 | 0.5 |" in text
    assert "1 of 2 cells are at least as good" in text
    whole = page(tmp_path / "results")
    assert "Where carom is worse" in whole
    assert "0, cp3 e: 0.5 (paper " in whole
    assert "Of 2 cells that can be compared 1 are" in whole
    assert text in whole


def test_other_readings_are_shown_but_do_not_count():
    wanted = table("s4")
    jobs = wanted.jobs(1)
    content = collect(wanted, {job: report_of(wanted.cells[0], 0.5) for job in jobs}, seeds=1, quick=False)
    assert content["summary"]["compared"] == 16
    assert len(content["cells"]) == 24
    assert "| (better) |" in markdown(content)
    models = {job.contact_model for job in jobs if job.data == "lcp" and job.task == "cp3"}
    assert models == {"cm", "coulomb", "lcp"}
    assert {job.contact_model for job in jobs if job.task == "cp3-e"} == {"cm"}


def test_an_error_that_is_not_finite_is_shown_in_its_bounded_form():
    wanted = table("s10")
    job = wanted.jobs(1)[1]
    content = collect(wanted, {job: report_of(wanted.cells[1], float("inf"))}, seeds=1, quick=False)
    assert content["cells"][1]["verdict"] == "worse"
    assert "not finite (bounded: 0.75)" in markdown(content)


def test_standard_errors_and_pictures(tmp_path):
    wanted = table("properties")
    jobs = wanted.jobs(1)[:1]
    content = collect(wanted, {job: report_of(wanted.cells[0], 0.5) for job in jobs}, seeds=1, quick=False)
    assert content["cells"][0]["standard_error"] == pytest.approx(0.05)
    assert "| standard error |" in markdown(content)
    write(content, tmp_path)
    wanted = table("figure3")
    jobs = [job for job in wanted.jobs(2) if job.task in ("cp3", "gyro")]
    content = collect(wanted, {job: report_of(wanted.cells[0], 0.5) for job in jobs}, seeds=2, quick=False)
    (first,) = [c for c in content["over_time"] if (c["row"], c["column"]) == ("CM-CD-CLNN", "cp3")]
    assert list(mean_over_seeds(first, "state")["mean"][:3]) == [0.0, 0.5, 1.0]
    assert np.isnan(mean_over_seeds(first, "state")["mean"][-1])
    assert mean_over_seeds(first, "energy")["ci95"][1] == pytest.approx(0.25 / np.sqrt(2), rel=1e-3)
    assert len(content["over_time"]) == 14
    (cell,) = [cell for cell in content["cells"] if (cell["row"], cell["column"]) == ("CM-CD-CLNN", "cp3")]
    assert cell["early"] == pytest.approx(0.5 * 10.5)  # the mean of steps 1 to 20
    assert "of carom, first 20 steps" in markdown(content)
    write(content, tmp_path)
    drawn = pictures(tmp_path, tmp_path / "images")
    assert [path.name for path in drawn] == ["errors_over_time.png", "energy_over_time.png", "contact_properties.png"]
    assert all(path.stat().st_size > 10_000 for path in drawn)
    assert "images/energy_over_time.png" in page(tmp_path)
    assert "images/contact_properties.png" in page(tmp_path)


def test_contact_properties_in_brief_are_the_largest_errors(tmp_path):
    wanted = table("properties")
    (bp5,) = [job for job in wanted.jobs(1) if (job.task, job.model, job.contact_model) == ("bp5", "clnn", "cm")]
    report = report_of(wanted.cells[0], 0.5)
    true = task("bp5")
    report["learned"]["friction"] = [*np.asarray(true.friction) + 1e-6]
    report["learned"]["restitution"] = [*np.asarray(true.restitution) + 1e-7]
    report["learned"]["friction"][3] += 2e-5
    report["learned"]["friction"][7] += 0.3  # which the data do not tell
    report["identification"]["friction"][7] = {"standard_error": None}
    content = collect(wanted, {bp5: report}, seeds=1, quick=False)
    assert "| bp5 | 60 | 2e-05 (3e-01), 1e-07 |" in brief(content)
    assert len([line for line in brief(content).splitlines() if line.startswith("|")]) == 3
    write(content, tmp_path)
    assert brief(content) in page(tmp_path)


def test_noise_of_pendulums_is_on_angles_and_rates():
    truth = carom.task("cp3")
    rng = np.random.default_rng(0)
    angles, rates = rng.uniform(-2, 2, size=(2, 50, 11, 3))
    lengths = np.array([0.35, 0.4, 0.35])
    x, v = (np.asarray(part) for part in chain_state(*map(jnp.asarray, (angles, rates, lengths))))
    exact = carom.Recording.of(x, v, dt=0.01, task="cp3")
    found = noisy("cp3", exact, 0.05, rng)
    assert np.abs(np.asarray(truth.constraints(jnp.asarray(found.x)))).max() < 1e-12
    again = chain_angles(found.x, found.v)
    assert np.allclose(again[2], lengths)
    assert np.std(again[0] - angles) == pytest.approx(0.05, rel=0.05)
    assert np.std(again[1] - rates) == pytest.approx(0.05, rel=0.05)
    points = noisy("bp5", exact, 0.05, rng)
    assert np.std(points.x - x) == pytest.approx(0.05, rel=0.05)
    assert np.array_equal(noisy("cp3", exact, 0.0, rng).length, exact.length)
    with refused("sd must be a finite number of at least 0; it was -1"):
        noisy("cp3", exact, -1.0, rng)


def test_jobs_have_names_and_digests_of_their_settings():
    jobs = [JOB, Job("cp3", noise=0.05), Job("cp3", epsilon="learn", contact_model="cmr"), Job("cp3", data="lcp")]
    assert [job.name for job in jobs] == [
        "cp3-clnn-cm-seed0",
        "cp3-clnn-cm-noise0.05-seed0",
        "cp3-clnn-cmr-epslearn-seed0",
        "cp3-clnn-cm-on-lcp-seed0",
    ]
    assert len({job.digest() for job in jobs} | {JOB.digest(quick=True)}) == 5


def test_wrong_requests_are_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for arguments, message in (
        (["s3", "--seeds", "0"], "seeds must be at least 1; it was 0"),
        (["s3", "--only", "cp4"], "only must be in the name of a training of s3, e.g. cp3-clnn-cm-seed0; it was 'cp4'"),
        (["s3", "--workers", "0"], "workers must be at least 1; it was 0"),
        (
            ["all", "--only", "cp4"],
            "only must be in the name of a training of all, e.g. bp5-e-clnn-cm-seed0; it was 'cp4'",
        ),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(["reproduce", *arguments])
        assert stopped.value.code == 2
        assert message in capsys.readouterr().err
    path = tmp_path / "runs" / "reproduce" / JOB.name
    path.mkdir(parents=True)
    (path / "config.json").write_text("{}")
    with refused("was learned with other settings. Choose another folder with --runs."):
        JOB.run(tmp_path / "runs" / "reproduce")


def test_the_time_to_go_is_that_of_trainings_with_other_seeds():
    earlier = {"runs": {"cp3-clnn-cm-seed0": {"seconds": 120.0}, "cp3-clnn-cm-seed2": {"seconds": 240.0}}}
    assert _minutes(dataclasses.replace(JOB, seed=1), earlier) == 3.0
    assert _minutes(Job("cp3", noise=0.05), earlier) == _minutes(JOB, None) == MINUTES["cp3"]


def test_all_tables_leave_out_those_that_are_not_asked_for(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main(["reproduce", "all", "--only", "noise", "--collect", "--seeds", "1"])
    assert "s6: 0 of 4 trainings to do" in capsys.readouterr().out
    assert [path.name for path in sorted((tmp_path / "results").iterdir())] == ["s6.json", "s6.md"]


@pytest.mark.slow
def test_a_quick_table_and_what_is_finished_is_not_done_again(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAROM_CACHE", "")
    main(["reproduce", "s3", "--quick"])
    assert "2 of 2 trainings to do" in capsys.readouterr().out
    content = json.loads((tmp_path / "results" / "quick" / "s3.json").read_text())
    assert content["quick"]
    assert sum(cell["carom"] is not None for cell in content["cells"]) == 4
    main(["reproduce", "s3", "--quick"])
    assert "0 of 2 trainings to do" in capsys.readouterr().out
    assert json.loads((tmp_path / "results" / "quick" / "s3.json").read_text())["cells"] == content["cells"]
    main(["reproduce", "page", "--results", "results/quick", "--page", "page.md"])
    assert "S.3: mass ratios" in (tmp_path / "page.md").read_text()
