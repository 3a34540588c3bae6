"""Writing whole files: what is replaced, followed, written into or refused, and what is left after a failure."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import threading
import time

import pytest

from pdal_stages.base import files
from pdal_stages.base.errors import StageError
from pdal_stages.base.files import PREFIX, sweep, whole_files, write_whole

unix = pytest.mark.skipif(os.name == "nt", reason="links, modes and devices of Unix")


def names(folder):
    return sorted(os.listdir(folder))


def test_several_files_appear_together_or_not_at_all(tmp_path):
    a, b = tmp_path / "a.txt", tmp_path / "b.txt"
    b.write_text("older")
    with pytest.raises(ZeroDivisionError), whole_files(a, b) as (one, two):
        one.write_text("1")
        two.write_text("2")
        assert names(tmp_path) != ["b.txt"]
        raise ZeroDivisionError
    assert names(tmp_path) == ["b.txt"] and b.read_text() == "older"

    def check(made, final, number):
        assert number == [a, b].index(final)
        if final == b:
            raise StageError("not whole", found=str(made))

    with pytest.raises(StageError, match="not whole") as caught, whole_files(a, b, check=check) as partials:
        for partial in partials:
            partial.write_text("new")
    assert str(b) in str(caught.value) and PREFIX not in str(caught.value)
    assert names(tmp_path) == ["b.txt"]
    with whole_files(a, b) as partials:
        for partial in partials:
            partial.write_text("new")
    assert names(tmp_path) == ["a.txt", "b.txt"] and a.read_text() == b.read_text() == "new"


def test_a_writer_that_writes_nothing_is_an_error(tmp_path):
    with pytest.raises(StageError, match="wrote no file"), whole_files(tmp_path / "a.txt"):
        pass
    assert names(tmp_path) == []


def test_numbered_files_and_files_beside(tmp_path):
    with whole_files(tmp_path / "t_#.las") as (partial,):
        for name in ("t_1.las", "t_2.las", "t_1.idx"):
            partial.with_name(name).write_text(name)
    assert names(tmp_path) == ["t_1.idx", "t_1.las", "t_2.las"]
    with whole_files(tmp_path / "u_#.las"):
        pass  # a splitter may give no piece
    assert len(names(tmp_path)) == 3


def test_the_longest_name_there_is(tmp_path):
    name = "ä" * 125 + ".json"
    write_whole(tmp_path / name, b"x")
    assert names(tmp_path) == [name]
    with pytest.raises(StageError, match="longer than 255 bytes"):
        write_whole(tmp_path / f"a{name}", b"x")


def test_two_writers_of_one_name_at_once(tmp_path):
    contents = [bytes([65 + n]) * 3_000_000 for n in range(4)]
    threads = [threading.Thread(target=write_whole, args=(tmp_path / "p.png", c)) for c in contents]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert names(tmp_path) == ["p.png"] and (tmp_path / "p.png").read_bytes() in contents


@unix
def test_a_link_is_followed(tmp_path):
    (tmp_path / "there").mkdir()
    for before in (True, False):
        target = tmp_path / "there" / f"{before}.txt"
        if before:
            target.write_text("older")
        link = tmp_path / f"{before}.link"
        link.symlink_to(target)
        write_whole(link, b"new")
        assert link.is_symlink() and target.read_bytes() == b"new" and not target.is_symlink()
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    with pytest.raises(StageError, match="leads to itself"):
        write_whole(loop, b"new")
    assert loop.is_symlink()


@unix
@pytest.mark.parametrize("mode", [0o600, 0o640, 0o755])
def test_the_mode_of_an_older_file_stays(tmp_path, mode):
    path = tmp_path / "a.txt"
    path.write_text("older")
    path.chmod(mode)
    write_whole(path, b"new")
    assert stat.S_IMODE(path.stat().st_mode) == mode


@unix
def test_a_new_file_has_the_usual_mode(tmp_path):
    before = os.umask(0o027)
    try:
        write_whole(tmp_path / "a.txt", b"x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == 0o640


@unix
def test_a_write_protected_file_is_refused(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("older")
    path.chmod(0o444)
    with pytest.raises(StageError, match="write-protected"):
        write_whole(path, b"new")
    assert path.read_text() == "older" and names(tmp_path) == ["a.txt"]


@unix
def test_a_pipe_is_written_into(tmp_path):
    pipe, content = tmp_path / "pipe", os.urandom(300_000)
    os.mkfifo(pipe)
    read = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    write_whole(pipe, content)
    reader.join()
    assert read == [content] and stat.S_ISFIFO(pipe.stat().st_mode) and names(tmp_path) == ["pipe"]


@unix
@pytest.mark.parametrize("name", ["/dev/null", "/dev/stdout", "/dev/stderr", "/dev/fd/1", "/proc/self/fd/1"])
@pytest.mark.parametrize("into", ["pipe", "file"])
def test_devices_stay_what_they_are(tmp_path, name, into):
    program = (
        "import sys; from pdal_stages.base.files import check_writable, write_whole\n"
        f"print('before'); check_writable({name!r}); write_whole({name!r}, b'content\\n'); print('after')"
    )
    before = os.lstat(name) if os.path.lexists(name) else None
    if before is None:
        pytest.skip(f"no {name} here")
    seen = tmp_path / "seen"
    with open(seen, "w") as out:
        out.write("older\n")
        out.flush()
        target = out if into == "file" else subprocess.PIPE
        done = subprocess.run(
            [sys.executable, "-c", program], stdout=target, stderr=subprocess.STDOUT, text=True, check=True
        )
    if name != "/proc/self/fd/1":
        after = os.lstat(name)
        assert (before.st_ino, before.st_mode, before.st_rdev) == (after.st_ino, after.st_mode, after.st_rdev)
    text = seen.read_text().removeprefix("older\n") if into == "file" else done.stdout
    lines = text.split()
    assert sorted(lines) == sorted(["before", *(["content"] if name != "/dev/null" else []), "after"]), lines
    if name in ("/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"):
        assert lines == ["before", "content", "after"]
    assert names(tmp_path) == ["seen"]


@unix
def test_a_full_device_is_an_error():
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full here")
    with pytest.raises(StageError, match=r"No space left on device\)\. Make room"):
        write_whole("/dev/full", b"x" * 100)


@unix
def test_a_socket_and_a_folder_are_refused(tmp_path):
    import socket

    with socket.socket(socket.AF_UNIX) as one:
        here = os.getcwd()
        os.chdir(tmp_path)  # a socket's name may not be long
        try:
            one.bind("s")
        finally:
            os.chdir(here)
        with pytest.raises(StageError, match="cannot be written to"):
            write_whole(tmp_path / "s", b"x")
    with pytest.raises(StageError, match="names a folder"):
        write_whole(tmp_path, b"x")
    with pytest.raises(StageError, match="does not exist"):
        write_whole(tmp_path / "no" / "a", b"x")
    assert names(tmp_path) == ["s"]


KILLED = """
import os, signal, sys
from pdal_stages.base.files import whole_files
with whole_files(sys.argv[1]) as (partial,):
    partial.write_text("half")
    print(partial, flush=True)
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGKILL)
"""


@unix
def test_leftovers_of_the_dead_go_and_of_the_living_stay(tmp_path, monkeypatch):
    def start(name):
        process = subprocess.Popen(
            [sys.executable, "-c", KILLED, str(tmp_path / name)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        return process, process.stdout.readline().strip()

    dead, left = start("dead[1].txt")
    alive, working = start("alive.txt")
    dead.communicate("")
    assert os.path.exists(left)
    strange = tmp_path / f"{PREFIX}strange"
    strange.mkdir()
    (strange / "o.txt").touch()  # without a lock: it is not known whose it is
    empty = tmp_path / f"{PREFIX}empty"
    empty.mkdir()  # of a process that was killed when it had removed the lock
    foreign = tmp_path / f"{PREFIX}link"
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / ".lock").touch()
    foreign.symlink_to(tmp_path / "folder")
    monkeypatch.setattr(files, "_swept", set())
    write_whole(tmp_path / "other.txt", b"x")
    assert not os.path.exists(left) and os.path.exists(working)
    assert (
        not empty.exists()
        and strange.is_dir()
        and foreign.is_symlink()
        and (tmp_path / "folder" / ".lock").exists()
    )
    old = time.time() - 2 * files._GRACE
    os.utime(strange, (old, old))
    sweep(tmp_path)
    assert not strange.exists()
    alive.communicate("")
    sweep(tmp_path)
    assert names(tmp_path) == [foreign.name, "folder", "other.txt"]


def test_the_lock_is_removed_last(tmp_path, monkeypatch):
    """So that a process that is killed while it removes its folder leaves one that the next sweep removes."""
    gone, unlink = [], os.unlink

    def killed(path, **more):
        if len(gone) == 2:
            raise OSError("killed")
        gone.append(os.path.basename(path))
        unlink(path, **more)

    with monkeypatch.context() as patch, whole_files(tmp_path / "a#.txt") as (partial,):
        for number in range(3):
            (partial.parent / f"a{number}.txt").write_text("x")
        for name in ("b", "c", "d"):
            (partial.parent / name).mkdir()
        (partial.parent / "b" / "e.txt").touch()
        folder = partial.parent
        patch.setattr(os, "replace", lambda *_: None)
        patch.setattr(os, "unlink", killed)
    assert gone and ".lock" not in gone and (folder / ".lock").exists()
    sweep(tmp_path)
    assert not folder.exists()


@unix
def test_only_the_owner_enters_the_hidden_folder(tmp_path):
    with whole_files(tmp_path / "a.txt") as (partial,):
        assert stat.S_IMODE(partial.parent.stat().st_mode) == 0o700
        partial.write_text("x")


def test_sweeping_and_writing_at_once(tmp_path):
    """A sweep may meet a folder that was made but is not locked yet."""
    stop = threading.Event()

    def sweeper():
        while not stop.is_set():
            sweep(tmp_path)

    thread = threading.Thread(target=sweeper)
    thread.start()
    try:
        for number in range(300):
            write_whole(tmp_path / f"{number % 7}.txt", b"%d" % number)
            assert (tmp_path / f"{number % 7}.txt").read_bytes() == b"%d" % number
    finally:
        stop.set()
        thread.join()
