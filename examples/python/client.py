"""A client of the goal commander: an assignment, an error with its field, a stream, a watched mission.

    python3 -m pip install -r examples/python/requirements.txt
    mkdir -p examples/python/stubs && python3 -m grpc_tools.protoc -I proto/proto \
        --python_out=examples/python/stubs --grpc_python_out=examples/python/stubs \
        magex/v1/types.proto magex/v1/commander.proto
    python3 examples/python/client.py 127.0.0.1:7100

MAGEX_TOKEN holds a bearer token if the service wants one. MAGEX_TLS_CA names the authority of a service with TLS, and
MAGEX_TLS_CERT and MAGEX_TLS_KEY the client's own certificate and key if it wants one (PEM files).
"""

import os
import pathlib
import sys
import threading

import grpc
from google.rpc import error_details_pb2
from grpc_status import rpc_status

sys.path.insert(0, str(pathlib.Path(__file__).parent / "stubs"))

from magex.v1 import commander_pb2 as pb  # noqa: E402
from magex.v1 import commander_pb2_grpc  # noqa: E402
from magex.v1 import types_pb2 as types  # noqa: E402


def connect(address):
    """A channel, and the metadata that every call carries."""
    token = os.environ.get("MAGEX_TOKEN", "").strip()
    metadata = [("authorization", f"Bearer {token}")] if token else []
    ca, certificate, key = (
        pathlib.Path(path).read_bytes() if (path := os.environ.get(name)) else None
        for name in ("MAGEX_TLS_CA", "MAGEX_TLS_CERT", "MAGEX_TLS_KEY")
    )
    if ca is None:
        return grpc.insecure_channel(address), metadata
    credentials = grpc.ssl_channel_credentials(ca, private_key=key, certificate_chain=certificate)
    return grpc.secure_channel(address, credentials), metadata


def positions(points):
    return pb.Positions(dims=len(points[0]) if points else 2, coordinates=[x for point in points for x in point])


def wrong_fields(error):
    """The fields that an INVALID_ARGUMENT names."""
    for detail in rpc_status.from_call(error).details:
        bad = error_details_pb2.BadRequest()
        if detail.Unpack(bad):
            return [violation.field for violation in bad.field_violations]
    return []


def main():
    address = sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:7100"
    channel, metadata = connect(address)
    stub = commander_pb2_grpc.CommanderServiceStub(channel)

    team = pb.AssignRequest(
        agents=positions([(0, 0), (4, 0), (8, 0)]),
        goals=positions([(8, 1), (0, 1)]),
        agent_ids=["ada", "bob", "cy"],
        goal_ids=["south", "north"],
        scheduler=types.ASSIGNMENT_METHOD_EXACT,
    )
    answer = stub.Assign(team, metadata=metadata, timeout=5)
    for pair in answer.pairs:
        print(f"{pair.agent_id} -> {pair.goal_id} ({pair.distance:.2f})")
    for left in answer.agents_without_goal:
        print(f"{left.id} stays: {pb.UnassignedReason.Name(left.reason)}")
    assert [(p.agent_id, p.goal_id) for p in answer.pairs] == [("ada", "north"), ("cy", "south")]

    broken = pb.AssignRequest()
    broken.CopyFrom(team)
    broken.goals.coordinates[1] = float("nan")
    try:
        stub.Assign(broken, metadata=metadata, timeout=5)
        raise SystemExit("a position that is not a number was accepted")
    except grpc.RpcError as error:
        assert error.code() == grpc.StatusCode.INVALID_ARGUMENT
        print("refused:", error.details(), wrong_fields(error))
        assert wrong_fields(error) == ["goals.coordinates[1]"]

    # Planning again and again: the pairs in force are kept unless leaving them saves more than 0.5.
    def moving():
        for step in range(3):
            request = pb.AssignStreamRequest(sequence=step, team=team)
            request.team.agents.coordinates[0] = 0.1 * step
            request.team.current.add(agent_id="ada", goal_id="north")
            request.team.switching_cost = 0.5
            yield request

    for reply in stub.AssignStream(moving(), metadata=metadata, timeout=10):
        if reply.WhichOneof("result") is None:
            continue  # a heartbeat
        print(f"step {reply.sequence}: total {reply.answer.cost:.3f}")

    mission = pb.CreateMissionRequest(title="evening charge", switching_cost=2.0)
    for name, position in [("ada", (0, 0)), ("bob", (4, 0))]:
        mission.agents.add(id=name, position=position)
    for name, position in [("north", (0, 1)), ("south", (8, 1))]:
        mission.goals.add(id=name, position=position)
    mission_id = stub.CreateMission(mission, metadata=metadata, timeout=5).assignment.mission_id

    def ada_fails():
        update = pb.UpdateMissionRequest(mission_id=mission_id)
        update.agents.add(id="ada", state=pb.MEMBER_STATE_FAILED)
        stub.UpdateMission(update, metadata=metadata, timeout=5)

    changes = stub.WatchAssignments(
        pb.WatchAssignmentsRequest(mission_ids=[mission_id]), metadata=metadata, timeout=30
    )
    revisions = []
    for event in changes:
        if event.kind == pb.WATCH_KIND_HEARTBEAT:
            continue
        kind = pb.WatchKind.Name(event.kind)
        print(kind, f"revision {event.assignment.revision}" if event.HasField("assignment") else "")
        for change in event.assignment.changes:
            print("  ", change.explanation)
        if event.kind == pb.WATCH_KIND_SYNCED:
            threading.Thread(target=ada_fails).start()
        if event.kind == pb.WATCH_KIND_CHANGED:
            revisions.append(event.assignment.revision)
            stub.DeleteMission(pb.DeleteMissionRequest(mission_id=mission_id), metadata=metadata, timeout=5)
        if event.kind == pb.WATCH_KIND_DELETED:
            break
    assert revisions == [2]
    print("done")


if __name__ == "__main__":
    main()
