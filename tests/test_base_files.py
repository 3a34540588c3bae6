"""Writing whole files: what is replaced, followed, written into or refused, and what is left after a failure."""

from __future__ import annotations

import os
import socket
import stat
import subprocess
import sys
import threading

import pytest

from pdal_stages.base.errors import StageError
from pdal_stages.base.files import PREFIX, sweep, whole_files, write_whole

unix = pytest.mark.skipif(os.name == "nt", reason="links, modes and devices of Unix")


def names(folder):
    return sorted(os.listdir(folder))


def test_several_files_appear_together_or_not_at_all(tmp_path):
    a, b = tmp_path / "a.txt", tmp_path / "b.txt"
    b.write_text("older")
    with pytest.raises(ZeroDivisionError), whole_files(a, b) as (first, two):
        first.write_text("1")
        two.write_text("2")
        raise ZeroDivisionError
    assert names(tmp_path) == ["b.txt"] and b.read_text() == "older"

    def check(made, final, number):
        assert number == [a, b].index(final)
        if final == b:
            raise StageError("not whole", found=str(made))

    with (
        pytest.raises(StageError, match="not whole") as caught,
        whole_files(a, b, check=check) as partials,
    ):
        for partial in partials:
            partial.write_text("new")
    assert str(b) in str(caught.value) and PREFIX not in str(caught.value)
    assert names(tmp_path) == ["b.txt"]
    with pytest.raises(StageError, match="wrote no file"), whole_files(a):
        pass
    with whole_files(a, b) as partials:
        for partial in partials:
            partial.write_text("new")
            if os.name != "nt":
                assert stat.S_IMODE(partial.parent.stat().st_mode) == 0o700
    assert names(tmp_path) == ["a.txt", "b.txt"] and a.read_text() == b.read_text() == "new"


def test_numbered_files_and_files_beside(tmp_path):
    with whole_files(tmp_path / "t_#.las") as (partial,):
        for name in ("t_1.las", "t_2.las", "t_1.idx"):
            partial.with_name(name).write_text(name)
    assert names(tmp_path) == ["t_1.idx", "t_1.las", "t_2.las"]
    with whole_files(tmp_path / "u_#.las"):
        pass  # a splitter may give no piece
    assert len(names(tmp_path)) == 3


def test_two_writers_of_one_name_at_once_while_others_sweep(tmp_path):
    stop, longest = threading.Event(), "ä" * 125 + ".json"

    def sweeper():
        while not stop.is_set():
            sweep(tmp_path)

    contents = [bytes([65 + n]) * 300_000 for n in range(4)]
    writers = [
        threading.Thread(target=lambda c=c: [write_whole(tmp_path / longest, c) for _ in range(30)])
        for c in contents
    ]
    other = threading.Thread(target=sweeper)
    for thread in (other, *writers):
        thread.start()
    for thread in writers:
        thread.join()
    stop.set()
    other.join()
    assert names(tmp_path) == [longest] and (tmp_path / longest).read_bytes() in contents


@pytest.mark.skipif(os.name == "nt" or os.geteuid(), reason="only root can give files to others")
@pytest.mark.parametrize("kind", ["link", "chain", "dangling", "pipe"])
def test_links_and_pipes_of_other_users_are_refused(tmp_path, kind):
    """Linux does so in sticky folders: they count only if they are one's own or the folder's owner's."""
    shared, own_file, at = tmp_path / "shared", tmp_path / "mine", tmp_path / "shared" / "o"
    shared.mkdir()
    shared.chmod(0o1777)
    if kind != "dangling":
        own_file.write_text("mine")
    os.mkfifo(at) if kind == "pipe" else at.symlink_to(own_file)
    os.chown(at, 65534, -1, follow_symlinks=False)
    named = at
    if kind == "chain":
        named = tmp_path / "own"
        named.symlink_to("shared/o")
    with pytest.raises(StageError, match="link or pipe of another user"):
        write_whole(named, b"new")
    assert own_file.exists() == (kind != "dangling") and (
        not own_file.exists() or own_file.read_text() == "mine"
    )
    if kind != "pipe":
        os.chown(shared, 65534, -1)
        write_whole(named, b"new")
        assert own_file.read_bytes() == b"new"


@unix
def test_links_are_followed_and_modes_kept(tmp_path):
    (tmp_path / "there").mkdir()
    target, link = tmp_path / "there" / "a.txt", tmp_path / "link"
    link.symlink_to(target)
    before = os.umask(0o027)
    try:
        write_whole(link, b"new")
    finally:
        os.umask(before)
    assert link.is_symlink() and stat.S_IMODE(target.stat().st_mode) == 0o640
    target.chmod(0o755)
    write_whole(link, b"newer")
    assert link.is_symlink() and target.read_bytes() == b"newer" and not target.is_symlink()
    assert stat.S_IMODE(target.stat().st_mode) == 0o755


@unix
def test_what_is_refused_stays_what_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a socket's name may not be long
    (tmp_path / "protected").write_text("older")
    (tmp_path / "protected").chmod(0o444)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("socket")
        before = names(tmp_path)
        for name, says in {
            "socket": "cannot be written to",
            ".": "names a folder",
            "no/a": "does not exist",
            "protected": "write-protected",
            "a" * 256: "longer than 255 bytes",
        }.items():
            with pytest.raises(StageError, match=says):
                write_whole(tmp_path / name, b"new")
    assert names(tmp_path) == before and (tmp_path / "protected").read_text() == "older"
    if os.path.exists("/dev/full"):
        with pytest.raises(StageError, match=r"No space left on device\)\. Make room"):
            write_whole("/dev/full", b"x" * 100)


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
def test_leftovers_of_the_dead_go_and_of_the_living_stay(tmp_path):
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
    foreign = tmp_path / f"{PREFIX}link"
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine").touch()
    foreign.symlink_to(tmp_path / "folder")
    write_whole(tmp_path / "other.txt", b"x")
    assert not os.path.exists(left) and os.path.exists(working)
    alive.communicate("")
    sweep(tmp_path)
    assert (
        names(tmp_path) == [foreign.name, "folder", "other.txt"]
        and (tmp_path / "folder" / "mine").exists()
    )
