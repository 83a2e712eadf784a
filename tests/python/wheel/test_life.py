"""Threads, forks, signals, and interpreters that exit while training goes on: an exception or a clean end."""

import gc
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import nertca_vk
import pytest
from nertca_vk import Context
from scene import SIZE, drawn, empty, endless, filled, frames, geometry

# Where something hangs, this ends it; nothing takes a hundredth of it.
HANG_S = 300


def run(script: str, status: int = 0) -> subprocess.CompletedProcess[str]:
    """A program of its own, which must end with a status, and not by a signal."""
    before = "import os, signal, sys, threading\nimport nertca_vk, scene\n"
    outcome = subprocess.run(
        [sys.executable, "-X", "faulthandler", "-c", before + script],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert outcome.returncode == status, outcome
    return outcome


def silent(script: str) -> str:
    outcome = run(script)
    assert outcome.stderr == "", outcome
    return outcome.stdout


def test_what_a_callback_raises_ends_training_and_is_raised(context: Context) -> None:
    class Enough(Exception):
        pass

    def observer(progress: nertca_vk.Progress) -> None:
        if progress.step >= 7:
            raise Enough(progress.step)

    with endless(context) as made:
        with pytest.raises(Enough):
            made.train(progress=observer)
        assert made.progress().step >= 7
        made.start(progress=observer)
        with pytest.raises(Enough):
            made.wait()
        assert made.progress().state == "cancelled"
        assert made.wait() and made.wait(), "it is told once"
        assert made.train(3) == 3, "and nothing is lost"


def test_callbacks_may_ask_and_draw_but_not_end_what_they_are_called_by(context: Context) -> None:
    with endless(context) as made:
        seen: list[tuple[int, int]] = []

        def refused(*calls: Any) -> None:
            for call in calls:
                with pytest.raises(nertca_vk.BusyError):
                    call()

        def observer(progress: nertca_vk.Progress) -> bool:
            image = made.render(geometry(0), (SIZE, SIZE))
            seen.append((made.progress().step, image.size))
            refused(made.close, made.train, made.start)
            return len(seen) % 3 == 0

        def background_observer(progress: nertca_vk.Progress) -> bool:
            refused(made.stop)
            return made.wait(0.0) or observer(progress)

        made.train(progress=observer)
        made.start(progress=background_observer)
        assert made.wait()
        assert len(seen) == 6 and all(size == SIZE * SIZE for _, size in seen)


def test_threads_share_and_one_closes(context: Context) -> None:
    """Only the library's exceptions come of it, and every thread ends."""
    made = endless(context)
    made.start(progress=lambda progress: None)
    surprises: list[BaseException] = []
    began = threading.Barrier(8)

    def use(call: Any) -> None:
        first = True
        while True:
            try:
                call()
            except nertca_vk.HandleError:
                break
            except nertca_vk.Error:
                pass
            except BaseException as error:
                surprises.append(error)
                break
            finally:
                if first:
                    began.wait(HANG_S)
                    first = False

    calls: list[Any] = [
        lambda: drawn(made),
        lambda: made.volume(nertca_vk.Grid.around_isocentre(5.0)),
        made.save_bytes,
        made.progress,
        lambda: made.wait(0.01),
        made.pause,
        made.resume,
    ]
    threads = [threading.Thread(target=use, args=(call,)) for call in calls]
    for thread in threads:
        thread.start()
    began.wait(HANG_S)
    made.close()
    for thread in threads:
        thread.join(HANG_S)
    assert not any(thread.is_alive() for thread in threads) and surprises == []


def test_closing_ends_a_training_in_another_thread(context: Context) -> None:
    made = endless(context)
    trains = threading.Event()
    done: list[int] = []
    thread = threading.Thread(target=lambda: done.append(made.train(progress=lambda progress: trains.set())))
    thread.start()
    assert trains.wait(HANG_S)
    made.close()
    thread.join(HANG_S)
    assert not thread.is_alive() and done[0] > 0


def test_other_threads_run_while_a_call_does(context: Context) -> None:
    """Training would not end if its caller held Python meanwhile."""
    with endless(context) as made:
        stop = threading.Event()
        told = threading.Event()

        def end() -> None:
            told.wait(HANG_S)
            stop.set()

        threading.Thread(target=end).start()

        def observer(progress: nertca_vk.Progress) -> bool:
            told.set()
            return stop.is_set()

        assert made.train(progress=observer) > 0


def test_frames_are_numbered_though_threads_add_them(context: Context) -> None:
    with empty(context) as made:
        numbers: list[int] = []
        threads = [
            threading.Thread(target=lambda v=v, p=p, i=i: numbers.append(made.add_frame(i, geometry(v), phase=p)))
            for v, p, i in frames()
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(numbers) == list(range(9))


def test_what_nobody_refers_to_is_freed() -> None:
    context = Context()
    made = endless(context)
    made.start()
    del made
    gc.collect()
    assert context.describe()["memory_in_use"] == 0
    context.close()


INTERRUPTED = """
context = nertca_vk.Context()
made = scene.endless(context)
def interrupt():
    while made.progress().step < 5: pass
    os.kill(os.getpid(), signal.SIGINT)
{begin}
try:
    {call}
    print("not interrupted")
except KeyboardInterrupt:
    pass
step = made.progress().step
assert step >= 5, step
{after}
again = nertca_vk.Reconstruction.from_checkpoint(made.save_bytes(), context=context)
assert again.progress().step >= step
assert made.train(3) == 3
print("ended", made.progress().state)
"""


@pytest.mark.parametrize(
    "call", ["made.train()", "made.train(progress=lambda p: None)", "made.train(progress=lambda p: sum(range(10**5)) < 0)"]
)
def test_ctrl_c_ends_training_without_loss(call: str) -> None:
    begin = "threading.Thread(target=interrupt).start()"
    assert silent(INTERRUPTED.format(begin=begin, call=call, after="")) == "ended idle\n"


def test_ctrl_c_ends_a_wait_but_not_the_training() -> None:
    begin = "made.start(); threading.Thread(target=interrupt).start()"
    after = "assert made.progress().state == 'running'; made.stop()"
    assert silent(INTERRUPTED.format(begin=begin, call="made.wait()", after=after)) == "ended idle\n"


WHILE_TRAINING = """
import logging
logging.basicConfig(level=logging.CRITICAL)
made = scene.endless(nertca_vk.Context())
began = threading.Event()
def observer(progress):
    began.set()
"""


@pytest.mark.parametrize(
    "train",
    [
        "made.start(progress=observer)",
        "threading.Thread(target=lambda: made.train(progress=observer), daemon=True).start()",
    ],
)
@pytest.mark.parametrize("end", ["", "sys.exit(0)", "del made", "made.pause(); made.wait(0.5)"])
def test_the_interpreter_exits_while_training_goes_on(train: str, end: str) -> None:
    if "daemon" in train and "del" in end:
        end = ""  # its thread refers to it
    silent(f"{WHILE_TRAINING}{train}\nbegan.wait()\n{end}\n")


def test_an_error_ends_the_program_while_training_goes_on() -> None:
    outcome = run(f"{WHILE_TRAINING}made.start(progress=observer)\nbegan.wait()\nraise ValueError('the end')\n", 1)
    assert outcome.stderr.splitlines()[-1] == "ValueError: the end"


def test_a_callback_may_end_the_program() -> None:
    run(f"{WHILE_TRAINING}made.train(progress=lambda progress: sys.exit(3))\n", 3)


FORK = """
import warnings
warnings.simplefilter("ignore")  # of threads and forks: that is what this is about
context = nertca_vk.Context()
made = scene.endless(context)
made.start()
while made.progress().step < 3: pass
child = os.fork()
if child == 0:
    refused = 0
    for call in (made.progress, made.save_bytes, lambda: scene.drawn(made), lambda: made.train(1), context.describe,
                 nertca_vk.Context, nertca_vk.devices, lambda: scene.empty(context)):
        try:
            call()
        except nertca_vk.ForkedError as error:
            refused += "spawn" in str(error)
    made.close()
    context.close()
    assert refused == 8, refused
    sys.exit(7)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
made.stop()
assert made.train(2) == 2
print("parent goes on")
"""


def test_a_forked_child_gets_exceptions_and_its_parent_goes_on() -> None:
    assert silent(FORK) == "parent goes on\n"


def test_processes_that_are_spawned_work() -> None:
    script = """
import multiprocessing
context = nertca_vk.Context("none")
with multiprocessing.get_context("spawn").Pool(1) as pool:
    assert pool.apply(nertca_vk.devices) == nertca_vk.devices()
print("done")
"""
    assert silent(script) == "done\n"


def test_a_missing_driver_or_loader_names_the_package(tmp_path: Path) -> None:
    script = """
for call in (nertca_vk.Context, nertca_vk.devices, lambda: nertca_vk.Reconstruction(3)):
    try:
        call()
    except nertca_vk.DeviceError as error:
        print(error)
"""
    (tmp_path / "libvulkan.so.1").write_bytes(b"")
    for variables, package in (
        ({"VK_DRIVER_FILES": "/dev/null", "VK_ICD_FILENAMES": "/dev/null"}, "mesa-vulkan-drivers"),
        ({"LD_LIBRARY_PATH": str(tmp_path)}, "libvulkan1"),
    ):
        os.environ.update(variables)
        try:
            said = silent(script).splitlines()
        finally:
            for name in variables:
                del os.environ[name]
        assert len(said) == 3 and all(package in line for line in said), said
