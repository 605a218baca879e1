"""Reads that nobody waits for end."""

import threading

import pytest

from zsdata.source.ranges import ShardFile
from zsdata.source.stop import Stopped, check_stop, pause, stoppable


def test_a_stop_ends_reads_and_pauses_of_its_thread_until_the_block_ends(tmp_path):
    (tmp_path / "a.tar").write_bytes(bytes(1024))
    stop, others = threading.Event(), []
    with ShardFile(str(tmp_path / "a.tar")) as file:
        with stoppable(stop):
            assert file.read_at(0, 8) == bytes(8)
            pause(0.0)
            stop.set()
            for read in (check_stop, lambda: file.read_at(0, 8), lambda: pause(600.0)):
                with pytest.raises(Stopped):
                    read()
            other = threading.Thread(target=lambda: others.append(file.read_at(0, 8)))
            other.start()
            other.join()
        pause(0.0)
        assert others == [file.read_at(0, 8)] == [bytes(8)]
