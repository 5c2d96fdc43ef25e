"""The recording of the in-process run: replayed byte for byte on a node that is built anew."""

import json
from pathlib import Path

from canopen_conformance.case import all_cases
from canopen_conformance.links import core_node
from canopen_conformance.run import record


def test_recording_replays_byte_for_byte(tmp_path: Path) -> None:
    path = tmp_path / "conversations.jsonl"
    count = record(path)
    head, *conversations = map(json.loads, path.read_text(encoding="utf-8").splitlines())
    assert count == len(conversations) == len(all_cases())
    assert (head["node_id"], head["gauges"], head["layout"], head["noise"]) == (5, 3, "I", 0.0)
    for conversation in conversations:
        device = core_node(head["eds"].encode())
        for now_us, came, went in conversation["steps"]:
            sent, _due_us = device.step(now_us, [(can_id, bytes.fromhex(data)) for can_id, data in came])
            assert [[can_id, data.hex()] for can_id, data in sent] == went, conversation["case"]
