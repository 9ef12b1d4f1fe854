import os
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace

import joblib
import numpy as np
import pytest
import torch
import trimesh
from threadpoolctl import threadpool_limits

from train import generate as generating
from train.data.dataset import join, load_sequences, windows
from train.data.generation_config import Generation, random_figures, solve_chunk
from train.errors import DatasetError, MeshError, SurfaceError
from train.generate import generate, main
from train.physics.sensor_noise import Nuisances
from train.physics.simulated_sensor import SimulatedSensor
from train.surfaces.depth_image import Pose
from train.surfaces.poses import paper_targets, position_mm, positions_of, turned_back

SMALL = Generation(surfaces=("C", "small square", "glyph:7"), count=10, taps=2, chunk=3, seed=5)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The small dataset made in one go on one core, and its file."""
    path = tmp_path_factory.mktemp("whole") / "small.npz"
    generate(SMALL, path, jobs=1)
    return path


def test_what_is_made_is_what_was_asked_for(small):
    made = load_sequences(small)
    assert len(made) == SMALL.sequences == 10
    assert made.surfaces.tolist() == [SMALL.surfaces[i % 3] for i in range(10)]
    assert made.taps == 2
    assert made.seed == 5
    assert made.config == SMALL.facts()
    assert made.config["world"]
    assert Generation(**{name: value for name, value in made.config.items() if name != "world"}) == SMALL
    end_n, end_mm = made.force_n[..., -1], made.indentation_mm[..., -1]
    assert np.where(np.isclose(end_mm, 0.5), end_n < SMALL.force_n, np.isclose(end_n, SMALL.force_n, rtol=1e-2)).all()
    assert (np.diff(made.force_n, axis=-1) > 0).all()
    assert not small.with_name("small.npz.parts").exists()


def test_a_stored_tap_is_the_sensors(small):
    made = load_sequences(small)
    tap = SimulatedSensor().tap([str(made.surfaces[4])], [Pose(*made.poses[4, 0])], SMALL.force_n)
    # Solved among others in a chunk: the same but for the solver's own error.
    assert np.allclose(made.counts[4, 0], tap.counts[0], rtol=1e-2, atol=2)
    assert np.allclose(made.force_n[4, 0], tap.force_n[0], rtol=1e-3)
    drawn = made.patterns_at(np.array([4]), np.ones(1))
    assert np.allclose(drawn, tap.patterns[:, 0], atol=1e-3)
    assert (made.touching[4, 0] == tap.touching[0, 0]).all()
    earlier = SimulatedSensor().tap([str(made.surfaces[4])], [Pose(*made.poses[4, 1])], SMALL.force_n)
    assert np.allclose(made.counts[4, 1], earlier.counts[0], rtol=1e-2, atol=2)


def test_pose_errors_are_as_large_as_they_say_and_can_be_off():
    sent = turned_back(paper_targets(positions_of("test"), ("C",)), 4)
    paper = Generation(surfaces=("C",), poses="paper", split="test", pose_error_mm=0.0, pose_error_deg=0.0)
    assert np.allclose(solve_chunk(paper, 0).poses, sent)
    off = solve_chunk(replace(paper, pose_error_mm=0.2, pose_error_deg=1.0), 0).poses - sent
    assert 0.1 < off[..., :2].std() < 0.3
    assert 0.5 < off[..., 2].std() < 1.5
    assert np.abs(off[..., :2]).max() <= 0.4 + 1e-6


def test_the_papers_schedule_has_its_targets_whatever_k():
    for split, count in (("train", 504), ("validation", 72), ("test", 72)):
        for taps in (1, 7):
            assert Generation(poses="paper", split=split, taps=taps).sequences == count
    config = Generation(poses="paper", split="validation", chunk=20)
    rng = np.random.default_rng(0)
    poses = [pose for chunk in range(config.chunks) for pose in config.targets(chunk, rng).poses]
    assert poses == paper_targets(positions_of("validation")).poses
    assert {(pose.x_mm, pose.y_mm) for pose in poses} == {position_mm(1)}


def test_chunks_differ_and_each_is_the_same_again(small):
    made = load_sequences(small)
    assert made.pick(np.arange(3, 6)).sha256() == solve_chunk(SMALL, 1).sha256()
    assert len({tuple(row) for row in made.poses.reshape(-1, 3)}) == 20
    assert solve_chunk(replace(SMALL, seed=6), 1).counts.tobytes() != made.counts[3:6].tobytes()


def test_several_processes_make_the_same_to_the_bit(small, tmp_path):
    counted = []
    made = generate(SMALL, tmp_path / "small.npz", jobs=2, progress=counted.append)
    assert made.sha256() == load_sequences(small).sha256()
    assert sum(counted) == 20
    assert len(counted) == SMALL.chunks


@pytest.mark.parametrize("processes", [False, True])
def test_daskscluster_makes_the_same_through_joblibs_backend(small, tmp_path, processes):
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=2 - processes,
        processes=processes,
        dashboard_address=None,
        local_directory=str(tmp_path),
    )
    with cluster, distributed.Client(cluster), joblib.parallel_config(backend="dask"):
        made = generate(SMALL, tmp_path / "small.npz")
    assert made.sha256() == load_sequences(small).sha256()


def test_a_backend_without_generators_works_in_rounds(small, tmp_path):
    with joblib.parallel_config(backend="multiprocessing"), pytest.raises(ValueError, match="does not support"):
        joblib.Parallel(n_jobs=2, return_as="generator_unordered")
    with joblib.parallel_config(backend="multiprocessing"):
        made = generate(SMALL, tmp_path / "small.npz", jobs=2)
    assert made.sha256() == load_sequences(small).sha256()


def test_flat_and_curved_surfaces_lie_in_one_file(tmp_path):
    mixed = Generation(surfaces=("C", "C", "sphere:8", "C"), count=4, taps=1, chunk=2)
    made = generate(mixed, tmp_path / "mixed.npz", jobs=1)
    assert made.unit_patterns.shape == (4, 16, 80, 80)
    assert (made.unit_patterns[0] == made.unit_patterns[0, -1:]).all()
    area = made.touching[2].sum(axis=(1, 2))
    assert area[-1] > 3 * area[3] > 0
    _, patterns = windows(made, np.arange(4), 0.6, 5.0, Nuisances.none(), 0)
    share = made.share_at_force(np.arange(4), 5.0)[:, 0] * 0.6
    indentation_mm = made.indentation_at(np.arange(4), share[:, None])[:, 0]
    assert np.allclose(patterns.max(axis=(1, 2)), indentation_mm, rtol=0.03)


def start(path, jobs, count):
    command = [sys.executable, "-m", "train.generate", str(path)]
    options = ["--count", str(count), "--taps", "1", "--jobs", str(jobs)]
    return subprocess.Popen(
        [*command, *options], start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def wait_for_a_part(run, path):
    parts = path.with_name(path.name + ".parts")
    while not any(parts.glob("*.npz")):
        assert run.poll() is None, run.stderr.read().decode()
        time.sleep(0.01)
    return parts


def test_a_run_killed_at_once_goes_on_and_ends_with_the_same_bytes(tmp_path):
    path = tmp_path / "cut.npz"
    run = start(path, jobs=1, count=400)
    parts = wait_for_a_part(run, path)
    os.killpg(run.pid, signal.SIGKILL)
    assert run.wait() == -signal.SIGKILL
    run.communicate()
    assert not path.exists()
    kept = {part.name: part.stat().st_mtime_ns for part in parts.glob("*.npz")}
    assert 0 < len(kept) < 9
    solved = []
    config = Generation(count=400, taps=1)
    original = generating._solved

    def count(config, chunks, jobs):
        solved.extend(chunks)
        return original(config, chunks, jobs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generating, "_solved", count)
        made = generate(config, path, jobs=1)
    assert sorted([*solved, *(int(name[:-4]) for name in kept)]) == list(range(9))
    assert made.sha256() == generate(config, tmp_path / "whole.npz", jobs=1).sha256()
    assert not parts.exists()


def test_ctrl_c_ends_in_one_line_that_says_how_to_go_on(tmp_path):
    path = tmp_path / "cut.npz"
    run = start(path, jobs=2, count=4000)
    parts = wait_for_a_part(run, path)
    os.killpg(run.pid, signal.SIGINT)  # a terminal sends it to the workers too
    out, complaint = run.communicate()
    assert run.returncode == 130
    assert complaint.decode() == "train.generate: interrupted; the same command continues\n"
    assert not out
    assert any(parts.glob("*.npz"))


@pytest.mark.parametrize("unused", ["", "1 tasks have been successfully executed  but not used. Additionally, "])
def test_what_joblib_warns_of_after_an_interruption_is_not_shown(tmp_path, monkeypatch, recwarn, unused):
    def interrupted(*_):
        warnings.warn(f"{unused}4 tasks which were still being processed have been cancelled.", stacklevel=1)
        raise KeyboardInterrupt

    monkeypatch.setattr(generating, "generate", interrupted)
    assert main([str(tmp_path / "cut.npz"), "--count", "2"]) == 130
    assert not list(recwarn)


def test_a_semaphore_that_is_gone_already_adds_no_line(tmp_path):
    script = (
        "import sys; from train.generate import main\n"
        "code = main([sys.argv[1], '--count', '2', '--taps', '1', '--jobs', '2'])\n"
        "from joblib.externals.loky.backend import resource_tracker\n"
        "resource_tracker.register('/loky-never-made', 'semlock')\n"  # what an interrupted pool leaves now and then
        "sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path / "small.npz")], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stderr == ""


def test_damaged_parts_are_solved_anew_and_others_are_kept(small, tmp_path):
    path = tmp_path / "small.npz"
    folder = tmp_path / "small.npz.parts"
    folder.mkdir()
    solve_chunk(SMALL, 0).save(folder / "000000.npz")
    (folder / "000001.npz").write_bytes(b"cut sho")
    (folder / ".000002.npz.drafted").mkdir()  # as a killed run leaves it
    (folder / ".000002.npz.drafted" / "000002.npz").write_bytes(b"cut shorter")
    assert generate(SMALL, path, jobs=1).sha256() == load_sequences(small).sha256()
    assert [left.name for left in tmp_path.iterdir()] == ["small.npz"]


def test_what_was_made_otherwise_is_not_overwritten(small, tmp_path):
    before = small.read_bytes()
    with pytest.raises(DatasetError, match="exists and was made with other settings: delete it"):
        generate(replace(SMALL, seed=6), small, jobs=1)
    solved = []
    assert generate(SMALL, small, jobs=1, progress=solved.append).sha256() == load_sequences(small).sha256()
    assert small.read_bytes() == before
    folder = tmp_path / "other.npz.parts"
    folder.mkdir()
    solve_chunk(SMALL, 1).save(folder / "000001.npz")
    with pytest.raises(DatasetError, match="holds parts of another run: delete it"):
        generate(replace(SMALL, seed=6), tmp_path / "other.npz", jobs=1)


def test_the_number_of_threads_changes_no_bit_and_is_left_as_it_was():
    before, found = torch.get_num_threads(), []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        with threadpool_limits(threads):
            found.append(solve_chunk(SMALL, 1).sha256())
        assert torch.get_num_threads() == threads
    torch.set_num_threads(before)
    assert found[0] == found[1]


def test_random_figures_of_different_seeds_have_nothing_in_common():
    names = [set(random_figures(30, 20, seed)) for seed in (0, 1, 2)]
    assert [len(each) for each in names] == [50, 50, 50]
    assert not names[0] & names[1] | names[1] & names[2]
    for wrong in ((-1, 0), (0, 1_000_001)):
        with pytest.raises(DatasetError, match="expected 0 to 1000000"):
            random_figures(*wrong, 0)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"surfaces": ()}, "no surfaces to tap"),
        ({"taps": 0}, "taps is 0, expected 1 to 7"),
        ({"taps": 8}, "taps is 8"),
        ({"count": 0}, "count is 0, expected 1 or more"),
        ({"chunk": 0}, "chunk is 0"),
        ({"force_n": 0.0}, "force_n is 0.0"),
        ({"force_n": float("nan")}, "force_n is nan"),
    ],
)
def test_configurations_that_cannot_be_are_refused(changes, complaint):
    with pytest.raises(DatasetError, match=complaint):
        replace(SMALL, **changes)


def test_the_command_says_what_it_made_and_what_it_cannot(tmp_path, capsys):
    path = tmp_path / "out" / "taps.npz"
    line = [str(path), "--surfaces", "S, L", "--glyphs", "1", "--count", "3", "--taps", "1", "--jobs", "1"]
    assert main(line) == 0
    made = load_sequences(path)
    said = capsys.readouterr().out
    assert made.surfaces.tolist() == ["S", "L", "glyph:1000000"]
    assert f"{path}: 3 sequences, 3 poses, " in said
    assert f"sha256 {made.sha256()}" in said
    for wrong, complaint in (
        (["--surfaces", "Q"], "no surface 'Q'"),
        (["--surfaces", "none", "--glyphs", "0"], "no surfaces to tap"),
        (["--mesh", str(tmp_path / "absent.stl"), "--surfaces", "C"], "cannot be read: No such file"),
        (["--taps", "9"], "taps is 9"),
        (["--seed", "2"], "was made with other settings"),
    ):
        assert main([*line, *wrong]) == 1
        complained = capsys.readouterr().err
        assert complaint in complained
        assert complained.count("\n") == 1


def test_a_users_mesh_is_looked_at_before_anything_is_solved(tmp_path):
    for name, error in ((f"mesh:{tmp_path / 'absent.stl'}", MeshError), ("no such thing", SurfaceError)):
        with pytest.raises(error):
            generate(replace(SMALL, surfaces=(name,)), tmp_path / "x.npz", jobs=1)


def test_a_pose_beside_a_users_mesh_is_told_in_one_line(tmp_path):
    ring = trimesh.creation.annulus(r_min=28.0, r_max=30.0, height=3.0)
    ring.export(tmp_path / "ring.stl")
    with pytest.raises(DatasetError, match=r"ring\.stl"):
        generate(replace(SMALL, surfaces=(f"mesh:{tmp_path / 'ring.stl'}",)), tmp_path / "x.npz", jobs=1)


def test_a_users_mesh_that_has_changed_is_another_configuration(tmp_path):
    path = tmp_path / "part.stl"
    config = replace(SMALL, surfaces=(f"mesh:{path}",))
    trimesh.creation.icosphere(radius=10.0).export(path)
    first = config.facts()
    trimesh.creation.icosphere(radius=11.0).export(path)
    assert config.facts() != first
    path.unlink()
    with pytest.raises(DatasetError, match=r"part\.stl cannot be read: No such file"):
        config.facts()


@pytest.mark.parametrize("wrong", [{"angle_step_deg": 200.0}, {"angle_step_deg": float("nan")}, {"seed": -1}])
def test_configurations_that_cannot_be_are_refused_by_name(wrong):
    with pytest.raises(DatasetError, match=f"{next(iter(wrong))} is .*, expected"):
        replace(SMALL, **wrong)


def test_files_of_different_taps_do_not_join():
    one, two = (solve_chunk(replace(SMALL, taps=taps), 0) for taps in (1, 2))
    with pytest.raises(DatasetError, match="files of 1 and 2 taps a sequence"):
        join([one, two])
