"""A fleet: 20 robots, tasks that arrive, one robot that fails, and the waiting times beside those of "greedy nearest".

    python3 examples/python/fleet.py 127.0.0.1:7100 fleet.svg

The world is a simulation of one second per step. The commander keeps the fleet as a mission and plans it anew with every step;
finished tasks are forgotten by themselves, so this could go on for ever. The stubs are made as for client.py.
"""

import random
import sys

from client import commander_pb2_grpc, connect, pb

ROBOTS, SIDE, SECONDS = 20, 100.0, 900
# Tasks per second, seconds of work at a task, and when one robot fails and comes back.
RATE, WORK, FAILS, BACK = 0.42, 8.0, 300, 500


class World:
    """Robots and tasks; the same for both dispatchers."""

    def __init__(self):
        draw = random.Random(1)
        point = lambda: (draw.uniform(0, SIDE), draw.uniform(0, SIDE))
        self.robots = {f"robot-{k}": point() for k in range(ROBOTS)}
        self.speeds = {name: draw.uniform(1.0, 2.0) for name in self.robots}
        self.busy_until = dict.fromkeys(self.robots, 0.0)
        self.arrivals = [(t, f"task-{t}", point()) for t in range(SECONDS) if draw.random() < RATE]
        self.open, self.since, self.waited = {}, {}, []

    def new_tasks(self, now):
        new = {name: place for t, name, place in self.arrivals if t == now}
        self.open.update(new)
        self.since.update(dict.fromkeys(new, now))
        return new

    def works(self, robot, now):
        return not (robot == "robot-0" and FAILS <= now < BACK)

    def drive(self, goals, now):
        """Moves every robot towards its goal for a second. Returns the tasks that were begun."""
        begun = []
        for robot, task in goals.items():
            if self.busy_until[robot] > now or task not in self.open or not self.works(robot, now):
                continue
            (x, y), (gx, gy) = self.robots[robot], self.open[task]
            way = ((gx - x) ** 2 + (gy - y) ** 2) ** 0.5
            step = self.speeds[robot]
            if way > step:
                self.robots[robot] = (x + (gx - x) * step / way, y + (gy - y) * step / way)
                continue
            self.robots[robot] = self.open.pop(task)
            self.busy_until[robot] = now + WORK
            self.waited.append(now + 1 - self.since[task])
            begun.append(task)
        return begun

    def waiting_times(self):
        return sorted(self.waited + [SECONDS - self.since[task] for task in self.open])


def greedy_nearest():
    """Each free robot takes the nearest task that no robot has, and keeps it."""
    world, goals = World(), {}
    for now in range(SECONDS):
        world.new_tasks(now)
        goals = {robot: task for robot, task in goals.items() if task in world.open and world.works(robot, now)}
        for robot, (x, y) in world.robots.items():
            free = [task for task in world.open if task not in goals.values()]
            if robot not in goals and free and world.busy_until[robot] <= now and world.works(robot, now):
                goals[robot] = min(free, key=lambda task: (world.open[task][0] - x) ** 2 + (world.open[task][1] - y) ** 2)
        world.drive(goals, now)
    return world.waiting_times()


def with_commander(address):
    channel, metadata = connect(address)
    stub = commander_pb2_grpc.CommanderServiceStub(channel)
    world, goals, begun = World(), {}, []
    # A robot changes its goal only if that saves the team more than two seconds.
    create = pb.CreateMissionRequest(title="fleet", switching_cost=2.0)
    for name, place in world.robots.items():
        create.agents.add(id=name, position=place, speed=world.speeds[name])
    mission = stub.CreateMission(create, metadata=metadata, timeout=5).assignment.mission_id
    for now in range(SECONDS):
        update = pb.UpdateMissionRequest(mission_id=mission, time=now)
        for name, place in world.robots.items():
            state = pb.MEMBER_STATE_ACTIVE if world.works(name, now) else pb.MEMBER_STATE_FAILED
            update.agents.add(id=name, position=place, busy_until=world.busy_until[name], state=state)
        for task in begun:
            update.goals.add(id=task, state=pb.MEMBER_STATE_FINISHED)
        new = world.new_tasks(now)
        for task, place in world.open.items():
            # Tasks that have waited longer go first when there are more of them than robots.
            weight = 1.0 + (now - world.since[task]) / 30
            if task in new:
                update.goals.add(id=task, position=place, weight=weight)
            else:
                update.goals.add(id=task, weight=weight)
        assignment = stub.UpdateMission(update, metadata=metadata, timeout=5).assignment
        goals = {pair.agent_id: pair.goal_id for pair in assignment.pairs}
        begun = world.drive(goals, now)
    assert len(assignment.goals) <= 100 + len(world.open) + len(begun) + 20, "finished tasks are forgotten"
    stub.DeleteMission(pb.DeleteMissionRequest(mission_id=mission), metadata=metadata, timeout=5)
    return world.waiting_times()


def plot(path, curves):
    """Share of the tasks that waited at most that time, as an SVG."""
    longest = max(times[-1] for _, _, times in curves)
    with open(path, "w", encoding="utf-8") as file:
        file.write('<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 640 360" font-family="sans-serif" font-size="14">')
        file.write('<path d="M60 20V300H620" fill="none" stroke="#444"/>')
        file.write('<text x="340" y="345" text-anchor="middle">waiting time, seconds</text>')
        file.write('<text x="20" y="160" transform="rotate(-90 20 160)" text-anchor="middle">share of tasks</text>')
        for share in (0, 50, 100):
            file.write(f'<text x="52" y="{304 - 2.8 * share}" text-anchor="end">{share} %</text>')
        for part in (0.25, 0.5, 0.75, 1.0):
            file.write(f'<text x="{60 + 560 * part}" y="320" text-anchor="middle">{longest * part:.0f}</text>')
        for k, (name, colour, times) in enumerate(curves):
            points = " ".join(
                f"{60 + 560 * wait / longest:.1f},{300 - 280 * (i + 1) / len(times):.1f}" for i, wait in enumerate(times)
            )
            file.write(f'<polyline points="60,300 {points}" fill="none" stroke="{colour}" stroke-width="2"/>')
            file.write(f'<text x="600" y="{240 + 20 * k}" text-anchor="end" fill="{colour}">{name}</text>')
        file.write("</svg>\n")


def main():
    address = sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:7100"
    curves = [("greedy nearest", "#c4421a", greedy_nearest()), ("commander", "#1a6fc4", with_commander(address))]
    for name, _, times in curves:
        mean, high = sum(times) / len(times), times[int(0.95 * len(times))]
        print(f"{name}: {len(times)} tasks, waiting {mean:.1f} s on average, 95 % below {high:.0f} s, at most {times[-1]:.0f} s")
    if len(sys.argv) > 2:
        plot(sys.argv[2], curves)
        print(f"plot: {sys.argv[2]}")
    greedy, own = (sum(times) / len(times) for _, _, times in curves)
    assert own < greedy, "the commander's tasks wait less"


if __name__ == "__main__":
    main()
