"""A policy of MAGE-X as a PyTorch module, written by `magex export --format torch`. Its weights are in @WEIGHTS@.

    policy = Policy.load()
    logits, actions, memory = policy(positions, velocities, goals, memory)

All inputs are [batch, agents, width] in single precision: positions, velocities and goals [.., D]; Push Ball: balls and
ball_velocities [.., D], each agent's own; drones: agent_state [.., 6]. Baselines that observe all landmarks take these, in the
order of their index, as goals (and all balls as balls). memory is None at the start of an episode, then what the last call
returned. logits [.., A] and actions [.., H] are along the axes of the world. state_dict() has the names of the weights file;
weights are stored [inputs, outputs], the transpose of torch.nn.Linear. docs/policy.md explains every number.
"""

import json
import math
import pathlib
import struct

import torch
from torch import nn

METADATA = json.loads(r"""@METADATA@""")
ABOUT = json.loads(METADATA["about"])


def read(path):
    """The tensors of a safetensors file, by name."""
    data = pathlib.Path(path).read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    header.pop("__metadata__", None)
    tensors = {}
    for name, entry in header.items():
        start, end = (8 + size + at for at in entry["data_offsets"])
        if entry["dtype"] != "F32":
            raise ValueError(f"{name} is {entry['dtype']}, not F32: convert it to single precision")
        tensors[name] = torch.frombuffer(bytearray(data[start:end]), dtype=torch.float32).reshape(entry["shape"])
    return tensors


def length(x):
    return (x * x).sum(-1, keepdim=True).sqrt()


def gelu(x):
    return 0.5 * x * (1 + torch.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))


class Policy(nn.Module):
    def __init__(self, tensors, half_side=None):
        super().__init__()
        self.executor, self.o, self.task = ABOUT["executor"], ABOUT["observation"], ABOUT["task"]
        self.kind, self.choices = self.executor["kind"], ABOUT["actions"]["choices"]
        if ABOUT["algorithm"] != "mappo":
            self.kind = "values"
        self.part = {"mat": "transformer", "mat-dec": "transformer", "values": "agent"}.get(self.kind, "actor")
        self.half_side = float(METADATA["half_side"]) if half_side is None else half_side
        self.pushes = self.o["balls"]
        self.relative = self.kind in ("magex", "attention", "mlp", "local")
        for name, tensor in tensors.items():
            if name.startswith(self.part + "."):
                *path, leaf = name.split(".")
                place = self
                for step in path:
                    if not hasattr(place, step):
                        place.add_module(step, nn.Module())
                    place = getattr(place, step)
                place.register_parameter(leaf, nn.Parameter(tensor, requires_grad=False))

    @classmethod
    def load(cls, path=None, half_side=None):
        path = path or pathlib.Path(__file__).parent / "@WEIGHTS@"
        return cls(read(path), half_side).eval()

    def w(self, name):
        place = getattr(self, self.part)
        for step in name.split("."):
            place = getattr(place, step)
        return place

    # What an agent sees.

    def frame(self, s):
        """Signs [.., 2] and whether the axes are swapped [.., 1]; None in the axes of the world."""
        if self.o["frame"] != "push":
            return None
        (tx, ty), (wx, wy) = ((v[..., :1], v[..., 1:]) for v in (s["balls"] - s["positions"], s["goals"] - s["balls"]))
        swap, cross = wy.abs() > wx.abs(), tx * wy - ty * wx
        back = torch.where(swap, wy, wx) < 0
        right = torch.where(swap ^ back, -cross, cross) < 0
        along, across = (1 - 2 * flag.to(wx.dtype) for flag in (back, right))
        return torch.cat([torch.where(swap, across, along), torch.where(swap, along, across)], -1), swap

    def see(self, frame, v):
        if frame is None:
            return v
        sign, swap = frame
        if v.dim() == 4:
            sign, swap = sign.unsqueeze(2), swap.unsqueeze(2)
        v = v * sign
        return torch.where(swap, v.flip(-1), v)

    def own(self, s, frame):
        p, v, speed, fade, success = s["positions"], s["velocities"], self.o["speed"], self.o["fade_radius"], self.o["success_radius"]
        if not self.relative:
            targets = [s["balls"], s["goals"]] if self.pushes else [s["goals"]]
            return torch.cat([v / speed, *(x / self.half_side for x in [p, *targets]), *s["extra"]], -1)
        parts = [self.see(frame, v) / speed]
        if not self.pushes:
            to = s["goals"] - p
            d = length(to)
            parts += [to / d.clamp(min=fade), to / (1 + d), (d <= success).to(d.dtype)]
            return torch.cat(parts + s["extra"], -1)
        to, way = s["balls"] - p, s["goals"] - s["balls"]
        near, left = length(to), length(way)
        behind = to - way * (0.25 / left.clamp(min=fade))
        to, way, behind = (self.see(frame, x) for x in (to, way, behind))
        legs = near.clamp(min=1e-6) * left.clamp(min=fade)
        parts += [to / near.clamp(min=fade), to / (1 + near), (3 * to).clamp(-1, 1)]
        parts += [self.see(frame, s["ball_velocities"]) / speed, way / left.clamp(min=fade), way / (1 + left)]
        parts += [(2 * behind).clamp(-2, 2), (to * way).sum(-1, keepdim=True) / legs]
        parts += [(to[..., :1] * way[..., 1:] - to[..., 1:] * way[..., :1]) / legs]
        parts += [(0.25 / near.clamp(min=1e-6)).clamp(max=2), left.clamp(max=1), (left <= success).to(left.dtype)]
        return torch.cat(parts + s["extra"], -1)

    def neighbours(self, s, frame):
        o, k = self.o, self.executor["neighbours"]
        batch, n, d = s["positions"].shape
        p = torch.cat([s["positions"], s["balls"]], 1) if self.pushes else s["positions"]
        v = torch.cat([s["velocities"], s["ball_velocities"]], 1) if self.pushes else s["velocities"]
        square = ((p.unsqueeze(1) - s["positions"].unsqueeze(2)) ** 2).sum(-1)
        hidden = torch.eye(n, dtype=torch.bool, device=p.device).repeat(1, 2 if self.pushes else 1)
        if o["out"] is not None:
            out = s["extra"][0][..., o["out"]] > 0
            hidden = hidden | out.unsqueeze(1) | out.unsqueeze(2)
        square = square.masked_fill(hidden | (square > o["sensing_radius"] ** 2), math.inf)
        square = nn.functional.pad(square, (0, k), value=math.inf)
        nearest, index = torch.sort(square, dim=-1, stable=True)
        nearest, index = nearest[..., :k], index[..., :k]
        exists = nearest.isfinite()
        index = index.masked_fill(~exists, 0)

        def pick(x):
            return torch.gather(x, 1, index.reshape(batch, n * k, 1).expand(-1, -1, d)).reshape(batch, n, k, d)

        offset, velocity = pick(p) - s["positions"].unsqueeze(2), pick(v) - s["velocities"].unsqueeze(2)
        distance, contact = length(offset), o["contact_radius"]
        offset, velocity = self.see(frame, offset), self.see(frame, velocity)
        parts = [offset, velocity / o["speed"], (contact / distance.clamp(min=1e-6)).clamp(max=2)]
        if o["encounters"]:
            speed = (velocity * velocity).sum(-1, keepdim=True).clamp(min=1e-4)
            time = (-(offset * velocity).sum(-1, keepdim=True) / speed).clamp(0, 2)
            miss = offset + velocity * time
            parts += [(2 * miss).clamp(-1, 1), time / 2, (contact / length(miss).clamp(min=1e-6)).clamp(max=2)]
        if self.pushes:
            parts += [(index >= n).to(p.dtype).unsqueeze(-1)]
        return torch.cat(parts, -1), exists.unsqueeze(-1).to(p.dtype)

    def vector(self, s):
        e, p = self.executor, s["positions"]
        batch, n, d = p.shape

        def put(points):
            to = points - p.unsqueeze(2)
            if e["nearest_first"]:
                order = torch.sort(length(to), dim=2, stable=True)[1].expand(-1, -1, -1, d)
                to = torch.gather(to, 2, order)
            return (to / self.half_side).reshape(batch, n, -1)

        parts = [s["velocities"] / self.o["speed"], p / self.half_side, *s["extra"]]
        if e["observes"] == "goals":
            parts += [(x - p) / self.half_side for x in ([s["balls"]] if self.pushes else []) + [s["goals"]]]
        else:
            parts += [put(x.unsqueeze(1).expand(-1, n, -1, -1)) for x in [s["goals"]] + ([s["balls"]] if self.pushes else [])]
        others = torch.tensor([[j for j in range(n) if j != i] for i in range(n)], device=p.device)
        parts += [put(p[:, others.reshape(-1)].reshape(batch, n, n - 1, d))]
        if e["agent_index"]:
            parts += [torch.eye(n, dtype=p.dtype, device=p.device).expand(batch, n, n)]
        return torch.cat(parts, -1)

    # The networks.

    def layer(self, name, x):
        return x @ self.w(name + ".weight") + self.w(name + ".bias")

    def norm(self, name, x):
        return nn.functional.layer_norm(x, x.shape[-1:], self.w(name + ".scale"), self.w(name + ".shift"), 1e-5)

    def gru(self, x, h):
        """Gates in the order reset, update, new."""
        (xr, xz, xn), (hr, hz, hn) = (y.chunk(3, -1) for y in (self.layer("gru.input", x), self.layer("gru", h)))
        reset, update = torch.sigmoid(xr + hr), torch.sigmoid(xz + hz)
        new = torch.tanh(xn + reset * hn)
        return new + update * (h - new)

    def crowd(self, name, s, frame):
        seen, exists = self.neighbours(s, frame)
        return (torch.relu(self.layer(name, seen)) * exists).sum(2)

    def team(self, s):
        batch, n, _ = s["positions"].shape
        v = s["velocities"] / self.o["speed"]
        nodes = [s["positions"] / self.half_side, v, *s["extra"]]
        if self.pushes:
            to = s["balls"] - s["positions"]
            nodes += [to / (1 + length(to))]
        x = torch.relu(self.layer("f_o", torch.cat(nodes, -1)))
        if self.kind == "mlp":
            return torch.relu(self.layer("concat", x.reshape(batch, 1, -1))).expand(batch, n, -1)
        if self.kind == "attention":
            q, k, v = self.layer("attention.qkv", x).reshape(batch, n, 3, 4, 16).permute(2, 0, 3, 1, 4)
            mixed = torch.softmax(q @ k.transpose(-1, -2) * 0.25, -1) @ v
            return self.layer("attention.out", mixed.transpose(1, 2).reshape(batch, n, 64))
        literal = self.kind == "magex-literal"
        total = x.sum(1, keepdim=True)
        h = (total / n).expand_as(x) if literal else torch.cat([x, (total - x) / max(n - 1, 1)], -1)
        h, pairs = torch.relu(self.layer("gcn", h)), torch.cat([s["positions"], v], -1)
        others = ~torch.eye(n, dtype=torch.bool, device=x.device)
        units, f = self.executor["pair_hidden"], self.executor["feature_size"]
        for b in range(self.executor["graph_blocks"]):
            sender, receiver, z, own = self.layer(f"block{b}.project", h).split([units, units, f, f], -1)
            if not literal:
                relative = pairs @ self.w(f"block{b}.relative")
                sender, receiver = sender - relative, receiver + relative
            score = self.w(f"block{b}.score")
            logits = torch.relu(sender.unsqueeze(2) + receiver.unsqueeze(1)) @ score[:-1] + score[-1]
            edges = ((logits > 0) & others).to(x.dtype)
            message = edges @ z / edges.sum(-1, keepdim=True).clamp(min=1)
            h = torch.relu(message if literal else own + message)
        return h

    def attend(self, name, asking, asked, causal=False):
        heads, (batch, n, d) = self.executor["attention_heads"], asking.shape
        parts = (("query", asking), ("key", asked), ("value", asked))
        q, k, v = (self.layer(f"{name}.{part}", x).reshape(batch, n, heads, d // heads).transpose(1, 2) for part, x in parts)
        score = q @ k.transpose(-1, -2) / math.sqrt(d // heads)
        if causal:
            score = score.masked_fill(torch.ones(n, n, device=score.device).triu(1) > 0, -math.inf)
        return self.layer(f"{name}.out", (torch.softmax(score, -1) @ v).transpose(1, 2).reshape(batch, n, d))

    def feed(self, name, x):
        return self.layer(name + ".narrow", gelu(self.layer(name + ".wide", x)))

    def head(self, x):
        return self.layer("logits.out", self.norm("logits.norm", gelu(self.layer("logits.wide", x))))

    def mat(self, s):
        blocks, norm = range(self.executor["attention_blocks"]), self.norm
        x = norm("encoder.norm", gelu(self.layer("encoder.embed", norm("encoder.vector_norm", self.vector(s)))))
        for b in blocks:
            x = norm(f"encoder.{b}.norm.0", x + self.attend(f"encoder.{b}.attention", x, x))
            x = norm(f"encoder.{b}.norm.1", x + self.feed(f"encoder.{b}.mlp", x))
        if self.kind == "mat-dec":
            return self.head(x)
        encoded, (batch, n, _) = x, x.shape
        # Agent by agent: an agent's token is the action of the agent before it.
        tokens = torch.zeros(batch, n, 1 + sum(self.choices), dtype=x.dtype, device=x.device)
        tokens[:, 0, 0] = 1
        out = []
        for i in range(n):
            x, e = norm("decoder.norm", gelu(tokens[:, : i + 1] @ self.w("decoder.embed.weight"))), encoded[:, : i + 1]
            for b in blocks:
                x = norm(f"decoder.{b}.norm.0", x + self.attend(f"decoder.{b}.own", x, x, True))
                x = norm(f"decoder.{b}.norm.1", e + self.attend(f"decoder.{b}.cross", e, x, True))
                x = norm(f"decoder.{b}.norm.2", x + self.feed(f"decoder.{b}.mlp", x))
            out.append(self.head(x[:, i : i + 1]))
            if i + 1 < n:
                tokens[:, i + 1 : i + 2, 1:] = self.one_hot(self.best(out[-1]), x.dtype)
        return torch.cat(out, 1)

    def best(self, logits):
        return torch.stack([part.argmax(-1) for part in logits.split(self.choices, -1)], -1)

    def one_hot(self, actions, dtype):
        parts = [nn.functional.one_hot(actions[..., k], size) for k, size in enumerate(self.choices)]
        return torch.cat(parts, -1).to(dtype)

    def network(self, s, frame, memory):
        if self.kind == "local":
            own = torch.relu(self.layer("own", self.own(s, frame)))
            mixed = self.layer("mix", torch.cat([own, self.crowd("neighbour", s, frame)], -1))
            return self.layer("head", torch.relu(mixed)), memory
        if self.kind in ("mat", "mat-dec"):
            return self.mat(s), memory
        if self.kind == "dicg":
            e = start = torch.tanh(self.layer("encoder.1", torch.tanh(self.layer("encoder.0", self.vector(s)))))
            mixing = torch.softmax(start @ self.w("attention.weight") @ start.transpose(-1, -2), -1)
            for b in range(2):
                e = torch.tanh(mixing @ (e @ self.w(f"graph.{b}.weight")) + self.w(f"graph.{b}.bias"))
            x = start + e
            for b in range(3):
                x = torch.tanh(self.layer(f"head.{b}", x))
            return self.layer("head.3", x), memory
        if self.kind in ("flat", "values"):
            values = self.kind == "values"
            act = torch.relu if values else torch.tanh
            width = self.executor["hidden"] if self.executor["recurrent"] else 0
            h, x = memory[..., :width], self.vector(s)
            if ABOUT["last_action"]:
                x = torch.cat([x, memory[..., width:]], -1)
            x = act(self.layer("first" if values else "own", x))
            if width:
                x = h = self.gru(x, h)
                x = x if values else self.norm("gru.norm", x)
            else:
                x = act(self.layer("second", x))
            logits = self.layer("head", x)
            if ABOUT["last_action"]:
                h = torch.cat([h, self.one_hot(self.best(logits), x.dtype)], -1)
            return logits, h
        fused = [torch.relu(self.layer("f_goal", self.own(s, frame))), self.team(s)]
        if hasattr(getattr(self, self.part), "f_near"):
            fused += [self.crowd("f_near", s, frame)]
        x = torch.cat(fused, -1)
        if self.executor["feature_norm"]:
            x = self.norm("f_state.norm", x)
        h = self.gru(torch.relu(self.layer("f_state", x)), memory)
        return self.layer("head", self.norm("gru.norm", h)), h

    @torch.no_grad()
    def forward(self, positions, velocities, goals, memory=None, balls=None, ball_velocities=None, agent_state=None):
        s = {"positions": positions, "velocities": velocities, "goals": goals, "balls": balls}
        s["ball_velocities"], s["extra"] = ball_velocities, [] if agent_state is None else [agent_state]
        if memory is None:
            memory = positions.new_zeros(*positions.shape[:2], ABOUT["memory"])
        frame = self.frame(s)
        logits, memory = self.network(s, frame, memory)
        if frame is not None:
            sign, swap = frame
            parts = [logits[..., :1]]
            for axis in range(2):
                for negative in range(2):
                    flipped = sign[..., axis : axis + 1] < 0

                    def along(a):
                        at = 1 + 2 * a
                        there, back = logits[..., at + negative : at + negative + 1], logits[..., at + 1 - negative : at + 2 - negative]
                        return torch.where(flipped, back, there)

                    parts.append(torch.where(swap, along(1 - axis), along(axis)))
            logits = torch.cat(parts, -1)
        return logits, self.best(logits), memory
