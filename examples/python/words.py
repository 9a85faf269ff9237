"""Every word of a fleet, said once: docs/how-do-i-say.md has the same examples. Run after client.py's stubs are made."""

import math
import sys

import grpc
from client import commander_pb2_grpc, connect, pb, positions, types, wrong_fields


def main():
    channel, metadata = connect(sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:7100")
    stub = commander_pb2_grpc.CommanderServiceStub(channel)

    def ask(**words):
        return stub.Assign(pb.AssignRequest(**words), metadata=metadata, timeout=5)

    def goals(**words):
        return {pair.agent_index: pair.goal_index for pair in ask(**words).pairs}

    def line(*xs):
        return positions([(x, 0) for x in xs])

    def pair(agent, goal):
        return pb.PairRef(agent_index=agent, goal_index=goal)

    # Nothing said: exact, and the least distance.
    plain = ask(agents=line(0, 4), goals=line(1, 5))
    assert plain.scheduler == types.ASSIGNMENT_METHOD_EXACT and plain.cost == plain.distance == 2
    # Positions in double precision.
    assert ask(agents=positions([(500000.25, 4649776.75)]), goals=positions([(500000.25, 4649777.0)])).cost == 0.25
    # Walls: path lengths in place of distances; infinity where there is no way.
    walls = pb.CostMatrix(agents=2, goals=2, values=[7, 3, math.inf, 4])
    assert goals(costs=walls) == {0: 0, 1: 1}
    sparse = pb.SparseCosts(agents=2, goals=2, agent_indices=[0, 0, 1], goal_indices=[0, 1, 1], values=[7, 3, 4])
    assert goals(sparse_costs=sparse) == {0: 0, 1: 1}
    # The last one should arrive soon: a power, or the makespan.
    spread = pb.CostMatrix(agents=2, goals=2, values=[0, 6, 6, 10])
    assert goals(costs=spread) == {0: 0, 1: 1} and goals(costs=spread, power=2) == {0: 1, 1: 0}
    assert goals(costs=spread, scheduler=types.ASSIGNMENT_METHOD_MAKESPAN) == {0: 1, 1: 0}
    # Speeds, and robots that are still busy.
    assert goals(agents=line(0, 3), goals=line(4), agent_speeds=[8, 1]) == {0: 0}
    assert goals(agents=line(0, 3), goals=line(4), agent_offsets=[0, 10]) == {0: 0}
    # Balance: the robot that has done less goes.
    assert goals(agents=line(1, 2), goals=line(0), agent_loads=[5, 1], balance=0.5) == {1: 0}
    # Priority.
    assert goals(agents=line(0), goals=line(1, 2), goal_weights=[1, 5]) == {0: 1}
    # A goal for two.
    assert goals(agents=line(0, 1, 9), goals=line(0, 9), goal_capacities=[2, 1]) == {0: 0, 1: 0, 2: 1}
    # Times: a robot that cannot be there in time does not go, and the answer says so.
    late = ask(agents=line(0), goals=line(5), goal_due=[4])
    assert not late.pairs and late.goals_without_agent[0].reason == pb.UNASSIGNED_REASON_TOO_LATE
    assert ask(agents=line(0), goals=line(5), goal_earliest=[8]).pairs[0].arrival == 8
    # One goal after another.
    order = [pb.Precedence(goal_index=0, after_index=1)]
    first = ask(agents=line(0, 9), goals=line(0, 9), precedence=order)
    assert first.goals_without_agent[0].reason == pb.UNASSIGNED_REASON_NOT_OPEN
    # A human decides.
    assert goals(agents=line(0, 4), goals=line(0, 4), pinned=[pair(0, 1)]) == {0: 1, 1: 0}
    for words, field in [
        ({"pinned": [pair(0, 1)], "forbidden": [pair(0, 1)]}, "pinned[0]"),
        ({"pinned": [pair(0, 1), pair(0, 0)]}, "pinned[1]"),
        ({"goal_earliest": [5, 0], "goal_due": [4, 1]}, "goal_due[0]"),
        ({"precedence": [*order, pb.Precedence(goal_index=1, after_index=0)]}, "precedence"),
        ({"power": 0.5}, "power"),
        ({"cost_overrides": [pb.PairCost(pair=pair(0, 0), cost=math.nan)]}, "cost_overrides[0].cost"),
    ]:
        try:
            ask(agents=line(0, 4), goals=line(0, 4), **words)
            raise SystemExit(f"{field}: accepted")
        except grpc.RpcError as error:
            print("refused:", error.details())
            assert wrong_fields(error) == [field], (field, wrong_fields(error))

    # The same in a mission, by name.
    mission = pb.CreateMissionRequest(time=100, power=2, balance=1)
    mission.agents.add(id="ada", position=(0, 0), speed=2, busy_until=110, load=1)
    mission.agents.add(id="bob", position=(9, 0))
    mission.goals.add(id="load", position=(500000.25, 4649776.75), weight=2, capacity=1, earliest=90, due=math.inf)
    mission.goals.add(id="unload", position=(1, 0), after=pb.GoalNames(goal_ids=["load"]))
    made = stub.CreateMission(mission, metadata=metadata, timeout=5).assignment
    assert list(made.goals[0].position) == [500000.25, 4649776.75]
    assert [(p.agent_id, p.goal_id) for p in made.pairs] == [("ada", "load")]

    def update(**words):
        request = pb.UpdateMissionRequest(mission_id=made.mission_id, **words)
        return stub.UpdateMission(request, metadata=metadata, timeout=5).assignment

    named = pb.PairRef(agent_id="bob", goal_id="load")
    assert [p.agent_id for p in update(pin=[named]).pairs] == ["bob"]
    back = update(unpin=[named], forfeit=["bob"])
    assert [(c.agent_id, c.reason) for c in back.changes if c.agent_id == "bob"] == [("bob", pb.CHANGE_REASON_FORFEITED)]
    done = update(goals=[pb.Member(id="load", state=pb.MEMBER_STATE_FINISHED)], time=120)
    assert [p.goal_id for p in done.pairs] == ["unload"] and done.agents[0].load == 2
    stub.DeleteMission(pb.DeleteMissionRequest(mission_id=made.mission_id), metadata=metadata, timeout=5)
    print("every word is understood")


if __name__ == "__main__":
    main()
