// An episode on a canvas: what moves, where it was sent, what is covered. A page brings the colours (as custom properties of
// its root) and says when to draw. It knows no task by name; three dimensions are seen from above, from the side and in space.
function fit(canvas) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) { canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio); }
  const g = canvas.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.clearRect(0, 0, w, h);
  return [g, w, h];
}
function color(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }
function cross(g, x, y, r) { g.beginPath(); g.moveTo(x - r, y - r); g.lineTo(x + r, y + r); g.moveTo(x - r, y + r); g.lineTo(x + r, y - r); }
// The largest 1, 2 or 5 times a power of ten that is not above a length.
function round(length) { const ten = 10 ** Math.floor(Math.log10(Math.max(1e-6, length))); return [5, 2, 1].map(k => k * ten).find(k => k <= length) ?? ten; }

// A view draws its episode at its time. `changed` is called when the pointer wants another picture.
function makeScene(canvas, data) {
  const view = { episode: null, time: 0, hover: null, changed() {}, load, draw, legend, chain: data.chain,
    show: { links: true, trails: true, ids: false, arrows: false, solid: data.ground !== null } };
  function decode(text, wide) {
    const raw = atob(text), bytes = Uint8Array.from(raw, c => c.charCodeAt(0));
    const bits = new DataView(bytes.buffer), size = wide ? 4 : 2, out = new Float32Array(bytes.length / size);
    for (let i = 0; i < out.length; i++) out[i] = (wide ? bits.getInt32(4 * i, true) : bits.getInt16(2 * i, true)) * data.unit;
    return out;
  }
  // Groups of bodies and places, from the agents to what is to be covered: each agent has one member of every group.
  const chain = data.chain, last2 = chain[chain.length - 2];
  const word = { agents: data.agent_name, balls: "ball", landmarks: "landmark" };
  view.word = word;

  // Everything a step shows is computed once per episode from the states.
  function load(source) {
    const { steps, agents, bodies, landmarks, dims, goals_per_agent } = source;
    const [positions, places, agent_state] = [source.positions, source.landmarks_at, source.agent_state_values].map(text => decode(text, source.wide));
    const e = { ...source, covered: [], share: [], contact: [], pushed: [], distances: [], lost: [], touches: [0], arrival: null };
    e.at = (t, i, d) => d < dims ? positions[(t * bodies + i) * dims + d] : 0;
    e.place = (k, d) => d < dims ? places[k * dims + d] : 0;
    e.extra = (t, i, x) => agent_state[(t * agents + i) * source.agent_state + x];
    e.out = (t, i) => data.out !== null && e.extra(t, i, data.out) > 0.5;
    e.first = group => group === "balls" ? agents : 0;
    // The k-th of agent i's chain, as an index into its group.
    e.member = (i, k) => k > 0 ? source.goals[i * goals_per_agent + k - 1] : i;
    const far = (a, i, b, j) => { let s = 0; for (let d = 0; d < dims; d++) s += (a[i + d] - b[j + d]) ** 2; return Math.sqrt(s); };
    const array = k => chain[k] === "landmarks" ? places : positions;
    const start = (t, i, k) => (chain[k] === "landmarks" ? e.member(i, k) : t * bodies + e.first(chain[k]) + e.member(i, k)) * dims;
    const coverers = last2 === "balls" ? [agents, bodies] : [0, agents], reach = data.contact_distance;
    // Contacts are soft: what pushes is now and then just outside the sum of the radii.
    const push = 1.02 * (data.agent_radius + data.ball_radius);
    let touches = 0;
    for (let t = 0; t <= steps; t++) {
      const covered = new Uint8Array(landmarks), contact = new Uint8Array(agents), pushed = new Uint8Array(bodies), row = t * bodies * dims;
      const sums = chain.slice(1).map(() => 0), gone = i => e.out(t, i), before = i => t > 0 && e.out(t - 1, i);
      let lost = 0;
      for (let i = coverers[0]; i < coverers[1]; i++) {
        if (last2 === "agents" && gone(i)) continue;
        const me = row + i * dims, x = positions[me];
        // The first coordinate alone settles most pairs.
        for (let g = 0; g < landmarks; g++) if (Math.abs(places[g * dims] - x) <= data.cover_radius && far(positions, me, places, g * dims) <= data.cover_radius) covered[g] = 1;
      }
      for (let i = 0; i < agents; i++) {
        const me = row + i * dims, x = positions[me];
        if (gone(i)) lost++;
        else for (let k = 0; k < sums.length; k++) {
          const way = far(array(k), start(t, i, k), array(k + 1), start(t, i, k + 1));
          sums[k] += way;
          if (k === 0 && chain[1] === "balls" && way < push) pushed[agents + e.member(i, 1)] = 1;
        }
        for (let j = 0; j < i; j++) {
          const other = row + j * dims;
          if (Math.abs(positions[other] - x) >= reach || far(positions, me, positions, other) >= reach || (before(i) && before(j))) continue;
          contact[i]++; contact[j]++; if (t > 0) touches += 2;
        }
      }
      e.covered.push(covered); e.contact.push(contact); e.pushed.push(pushed); e.lost.push(lost);
      e.distances.push(sums.map(sum => sum / (agents - lost)));
      e.share.push(covered.reduce((a, b) => a + b, 0) / Math.max(1, landmarks));
      e.touches[t] = t > 0 ? touches / (agents * t) : 0;
      if (t > 0 && e.arrival === null && e.share[t] >= 0.99) e.arrival = t;
    }
    // Everything that is ever seen fits, and so does the map.
    const half = data.side / 2, low = [-half, -half, data.ground ?? Infinity], high = [half, half, data.ground ?? -Infinity];
    const see = point => { for (let d = 0; d < 3; d++) { const x = point(d); low[d] = Math.min(low[d], x); high[d] = Math.max(high[d], x); } };
    e.heights = [Infinity, -Infinity];
    for (let t = 0; t <= steps; t++) for (let i = 0; i < bodies; i++) {
      see(d => e.at(t, i, d));
      e.heights = [Math.min(e.heights[0], e.at(t, i, 2)), Math.max(e.heights[1], e.at(t, i, 2))];
    }
    for (let g = 0; g < landmarks; g++) see(d => e.place(g, d));
    e.low = low; e.high = high;
    return e;
  }

  // A pane maps the world to the canvas: x and y are pixels, k is pixels per world unit there, depth grows towards the eye.
  let panes = [], angles = { turn: -1.15, rise: 0.36 };
  function lay(e, w, h) {
    const pad = 26, [wide, deep, tall] = [0, 1, 2].map(d => e.high[d] - e.low[d] || 1);
    if (e.dims < 3) {
      const scale = Math.max(1e-9, Math.min((w - 2 * pad) / wide, (h - 2 * pad) / deep));
      return [above(e, scale, (w - scale * wide) / 2, h - (h - scale * deep) / 2, [0, 0, w, h])];
    }
    // From above, and below it from the side: one x axis, one scale. The view in space gets the rest.
    const solid = view.show.solid, beside = solid && w > 1.15 * h, gap = 34, bottom = 44, air = 3 * data.agent_radius;
    const high = solid && !beside ? 0.6 * h : h;
    const scale = Math.max(1e-9, Math.min(((beside ? 0.5 : 1) * w - 2 * pad) / wide, (high - 2 * gap - bottom) / (deep + tall + air)));
    const column = beside ? scale * wide + 2 * pad : w, ox = (column - scale * wide) / 2;
    const slack = (high - 2 * gap - bottom - scale * (deep + tall + air)) / 2, cut = gap + slack + scale * deep + gap / 2 - 8;
    const first = above(e, scale, ox, gap + slack + scale * deep, [0, 0, column, cut]);
    const floor = high - bottom - slack;
    const second = { ...first, y: (x, y, z) => floor - (z - e.low[2]) * scale, depth: (x, y) => -y, box: [0, cut, column, high - cut], name: "from the side: x, z", side: true };
    first.name = "from above: x, y; fainter is lower"; first.shade = true;
    const spare = beside ? [column, 0, w - column, h] : [0, high, w, h - high];
    return solid ? [first, second, space(e, spare)] : [first, second];
  }
  function above(e, scale, ox, oy, box) {
    return { x: x => ox + (x - e.low[0]) * scale, y: (x, y) => oy - (y - e.low[1]) * scale, k: () => scale, depth: (x, y, z) => z, box, map: true };
  }
  function space(e, box) {
    const middle = e.low.map((x, d) => (x + e.high[d]) / 2), ball = Math.hypot(...e.low.map((x, d) => (e.high[d] - x) / 2)) || 1;
    const [ct, st, cr, sr] = [Math.cos(angles.turn), Math.sin(angles.turn), Math.cos(angles.rise), Math.sin(angles.rise)];
    const eye = 3.2 * ball, zoom = (Math.min(box[2], box[3]) / 2 - 14) * Math.sqrt(eye ** 2 - ball ** 2) / ball;
    const depth = (x, y, z) => cr * (ct * (x - middle[0]) + st * (y - middle[1])) + sr * (z - middle[2]);
    const k = (x, y, z) => zoom / (eye - depth(x, y, z));
    return {
      x: (x, y, z) => box[0] + box[2] / 2 + k(x, y, z) * (ct * (y - middle[1]) - st * (x - middle[0])),
      y: (x, y, z) => box[1] + box[3] / 2 - k(x, y, z) * (cr * (z - middle[2]) - sr * (ct * (x - middle[0]) + st * (y - middle[1]))),
      k, depth, box, turns: true, name: "in space: drag to turn",
    };
  }

  function draw() {
    const e = view.episode, [g, w, h] = fit(canvas);
    panes = lay(e, w, h);
    const t0 = Math.floor(view.time), t1 = Math.min(e.steps, t0 + 1), part = view.time - t0;
    const mix = (read, i, d) => read(t0, i, d) * (1 - part) + read(t1, i, d) * part;
    const now = { t0, part, bodies: [], states: [] };
    for (let i = 0; i < e.bodies; i++) now.bodies.push([0, 1, 2].map(d => mix(e.at, i, d)));
    for (let i = 0; i < e.agents; i++) now.states.push(Array.from({ length: e.agent_state }, (_, x) => mix(e.extra, i, x)));
    const c = Object.fromEntries(["line", "agent", "trail", "ball", "ball-trail", "goal", "covered", "crash", "link", "ink", "map", "soft"].map(name => [name, color(`--${name}`)]));
    for (const pane of panes) {
      g.save();
      if (panes.length > 1) { g.beginPath(); g.rect(...pane.box); g.clip(); }
      drawGround(g, pane, c); drawPane(g, pane, now, c); g.restore();
      if (!pane.name) continue;
      const [x, y, width, height] = pane.box;
      g.fillStyle = c.soft; g.font = "11px system-ui, sans-serif"; g.textAlign = "left"; g.fillText(pane.name, x + 14, y + 18);
      g.fillStyle = c.line; if (x > 0) g.fillRect(x, y, 1, height); if (y > 0) g.fillRect(x, y, width, 1);
    }
    // Scale bar: a round length near a fifth of the map.
    const length = round(data.side / 4), foot = panes.length > 1 ? panes[1].box[1] + panes[1].box[3] : h;
    g.strokeStyle = c.soft; g.fillStyle = c.soft; g.lineWidth = 1.5; g.font = "11px system-ui, sans-serif"; g.textAlign = "left";
    g.beginPath(); g.moveTo(14, foot - 12); g.lineTo(14 + length * panes[0].k(), foot - 12); g.stroke();
    g.fillText(`${length} ${length === 1 ? data.length_unit.slice(0, -1) : data.length_unit}`, 14, foot - 18);
  }
  function drawGround(g, pane, c) {
    const e = view.episode, half = data.side / 2, ground = data.ground ?? e.low[2];
    g.strokeStyle = c.line; g.lineWidth = 1;
    if (pane.map) { g.setLineDash([4, 4]); g.strokeRect(pane.x(-half), pane.y(0, half), data.side * pane.k(), data.side * pane.k()); g.setLineDash([]); }
    if (pane.side && data.ground !== null) {
      const [x, y, width, height] = pane.box, line = pane.y(0, 0, ground);
      g.globalAlpha = 0.5; g.fillStyle = c.line; g.fillRect(x, line, width, Math.min(8, y + height - line)); g.globalAlpha = 1;
      g.strokeStyle = c.soft; g.beginPath(); g.moveTo(x, line); g.lineTo(x + width, line); g.stroke();
      g.fillStyle = c.soft; g.font = "11px system-ui, sans-serif"; g.textAlign = "right"; g.fillText("ground", x + width - 10, line + 20);
    }
    if (!pane.turns) return;
    const line = (...points) => { g.beginPath(); for (const p of points) g.lineTo(pane.x(...p), pane.y(...p)); g.stroke(); };
    const step = round(data.side / 6), count = Math.floor(half / step + 1e-6);
    for (let n = -count; n <= count; n++) { line([n * step, -half, ground], [n * step, half, ground]); line([-half, n * step, ground], [half, n * step, ground]); }
    g.strokeStyle = c.soft; line([-half, -half, ground], [half, -half, ground], [half, half, ground], [-half, half, ground], [-half, -half, ground]);
    // Feet: where above the ground something is.
    g.strokeStyle = c.goal; g.globalAlpha = 0.35; g.setLineDash([2, 4]);
    for (let k = 0; k < e.landmarks; k++) line([0, 1, 2].map(d => e.place(k, d)), [e.place(k, 0), e.place(k, 1), ground]);
    g.setLineDash([]); g.globalAlpha = 1;
  }
  function drawPane(g, pane, now, c) {
    const e = view.episode, { t0, part } = now, own = i => view.hover === i;
    const spot = p => [pane.x(...p), pane.y(...p), pane.k(...p)];
    const b = now.bodies.map(spot), l = Array.from({ length: e.landmarks }, (_, k) => spot([e.place(k, 0), e.place(k, 1), e.place(k, 2)]));
    const member = (i, k) => chain[k] === "landmarks" ? l[e.member(i, k)] : b[e.first(chain[k]) + e.member(i, k)];
    const radius = (r, k) => Math.max(2, r * k), disc = (x, y, r) => { g.beginPath(); g.arc(x, y, r, 0, 7); };
    const size = i => i < e.agents ? data.agent_radius : data.ball_radius;
    // The bodies of the chain that the pointer is on.
    const held = new Set(view.hover === null ? [] : chain.flatMap((group, k) => group === "landmarks" ? [] : [e.first(group) + e.member(view.hover, k)]));

    if (pane.turns) for (const [x, y] of now.bodies) {
      const foot = [x, y, data.ground ?? e.low[2]], k = pane.k(...foot) * data.agent_radius;
      g.globalAlpha = 0.12; g.fillStyle = c.ink; g.beginPath(); g.ellipse(pane.x(...foot), pane.y(...foot), k, k * Math.sin(angles.rise), 0, 0, 7); g.fill(); g.globalAlpha = 1;
    }
    if (view.show.trails) {
      const px = (s, i) => pane.x(e.at(s, i, 0), e.at(s, i, 1), e.at(s, i, 2)), py = (s, i) => pane.y(e.at(s, i, 0), e.at(s, i, 1), e.at(s, i, 2));
      g.lineWidth = Math.max(1, Math.min(3, 0.05 * panes[0].k())); g.lineCap = "round";
      const span = Math.round(2.5 / data.step_seconds), first = Math.max(0, t0 - span);
      for (const [from, to, trail] of [[e.agents, e.bodies, c["ball-trail"]], [0, e.agents, c.trail]]) for (let s = first; s < t0 + (part > 0 ? 1 : 0); s++) {
        g.strokeStyle = `rgba(${trail}, ${(0.08 + 0.42 * (s - first + 1) / (span + 1)).toFixed(3)})`;
        g.beginPath();
        for (let i = from; i < to; i++) {
          g.moveTo(px(s, i), py(s, i));
          if (s + 1 <= t0) g.lineTo(px(s + 1, i), py(s + 1, i)); else g.lineTo(b[i][0], b[i][1]);
        }
        g.stroke();
      }
      for (const i of held) {
        g.strokeStyle = i < e.agents ? c.agent : c.ball; g.lineWidth = 2;
        g.beginPath(); for (let s = 0; s <= e.steps; s++) g.lineTo(px(s, i), py(s, i)); g.stroke();
      }
    }
    g.lineCap = "butt";
    for (let i = 0; i < e.agents; i++) {
      if (!own(i) && (!view.show.links || e.out(t0, i))) continue;
      g.strokeStyle = own(i) ? c.ink : c.link; g.lineWidth = own(i) ? 2 : 1;
      g.beginPath(); for (let k = 0; k < chain.length; k++) g.lineTo(member(i, k)[0], member(i, k)[1]); g.stroke();
    }
    l.forEach(([x, y, k], n) => {
      const on = e.covered[t0][n];
      if (on) { g.globalAlpha = 0.22; g.fillStyle = c.covered; disc(x, y, radius(data.cover_radius, k) + 3); g.fill(); g.globalAlpha = 1; }
      g.strokeStyle = on ? c.covered : c.goal; g.lineWidth = 2; disc(x, y, radius(data.landmark_radius, k) + 1.5); g.stroke();
    });
    const order = b.map((_, i) => b.length - 1 - i);
    if (e.dims > 2) order.sort((i, j) => pane.depth(...now.bodies[i]) - pane.depth(...now.bodies[j]));
    for (const i of order) {
      const [x, y, k] = b[i], r = radius(size(i), k), outline = held.has(i);
      if (i >= e.agents) {
        g.fillStyle = c.map; disc(x, y, r); g.fill();
        g.globalAlpha = 0.35; g.fillStyle = c.ball; g.fill(); g.globalAlpha = 1;
        g.strokeStyle = outline ? c.ink : e.pushed[t0][i] ? c.agent : c.ball; g.lineWidth = outline ? 2.5 : 2; disc(x, y, r - 1); g.stroke();
        continue;
      }
      const out = e.out(t0, i), fell = out && t0 > 0 && !e.out(t0 - 1, i), hit = e.contact[t0][i] > 0 || fell;
      if (hit) { g.globalAlpha = 0.30 * (1 - 0.6 * part); g.fillStyle = c.crash; disc(x, y, r * (1.5 + 0.5 * part)); g.fill(); }
      const depth = (now.bodies[i][2] - e.heights[0]) / (e.heights[1] - e.heights[0] || 1), shade = pane.shade ? 0.35 + 0.6 * depth : 0.82;
      g.fillStyle = out ? c.soft : hit ? c.crash : c.agent;
      g.strokeStyle = outline ? c.ink : c.map; g.lineWidth = outline ? 2 : 1;
      if (data.up === null || out) { g.globalAlpha = out ? 0.55 : shade; disc(x, y, r); g.fill(); g.globalAlpha = 1; g.stroke(); }
      else rotor(g, pane, now, i, r / k, shade, c);
      if (out) { g.strokeStyle = hit ? c.crash : c.ink; g.lineWidth = 1.8; cross(g, x, y, 0.6 * r); g.stroke(); }
      if (view.show.arrows && data.target_velocity !== null && !out) arrow(g, pane, now, i, c);
    }
    // Landmarks stay visible under what covers them.
    const dot = Math.min(data.landmark_radius, (last2 === "balls" ? data.ball_radius : data.agent_radius) / 2);
    l.forEach(([x, y, k], n) => { if (e.covered[t0][n]) { g.fillStyle = c.covered; disc(x, y, radius(dot, k)); g.fill(); g.strokeStyle = c.map; g.lineWidth = 1; g.stroke(); } });
    if (!view.show.ids && view.hover === null) return;
    g.fillStyle = c.ink; g.textAlign = "center"; g.font = "600 11px system-ui, sans-serif";
    b.forEach(([x, y, k], i) => {
      if (!view.show.ids && !held.has(i)) return;
      const name = i < e.agents ? `${i}${own(i) && e.out(t0, i) ? ` ${data.out_name}` : ""}` : held.has(i) ? `${word.balls} ${i - e.agents}` : i - e.agents;
      g.fillStyle = i < e.agents ? c.ink : c.ball;
      g.fillText(name, x, y - radius(size(i), k) - 3);
    });
    if (view.hover !== null) {
      const goal = e.member(view.hover, chain.length - 1), [x, y, k] = l[goal]; g.fillStyle = c.ink;
      g.fillText(`goal ${goal}`, x, y - radius(data.landmark_radius, k) - 8);
    }
  }
  // A drone: the ball that it must keep to itself, the disc of its rotors, and a mast that shows which way is up for it.
  function rotor(g, pane, now, i, r, shade, c) {
    const p = now.bodies[i], [ux, uy] = now.states[i].slice(data.up), uz = Math.sqrt(Math.max(0, 1 - ux * ux - uy * uy));
    const flat = Math.hypot(uz, ux), a = flat > 1e-6 ? [uz / flat, 0, -ux / flat] : [1, 0, 0], n = [ux, uy, uz];
    const s = [n[1] * a[2] - n[2] * a[1], n[2] * a[0] - n[0] * a[2], n[0] * a[1] - n[1] * a[0]];
    const spot = q => [pane.x(...q), pane.y(...q)], fill = g.fillStyle;
    g.globalAlpha = 0.25 * shade; g.beginPath(); g.arc(...spot(p), r * pane.k(...p), 0, 7); g.fill();
    g.globalAlpha = shade; g.beginPath();
    for (let m = 0; m < 20; m++) { const [co, si] = [Math.cos(m * Math.PI / 10), Math.sin(m * Math.PI / 10)]; g.lineTo(...spot(p.map((x, d) => x + r * (co * a[d] + si * s[d])))); }
    g.closePath(); g.fill();
    const edge = g.strokeStyle, width = g.lineWidth;
    g.strokeStyle = fill; g.lineWidth = 2; g.stroke(); g.globalAlpha = 1;
    g.strokeStyle = edge; g.lineWidth = width; g.beginPath(); g.arc(...spot(p), r * pane.k(...p) + 0.5, 0, 7); g.stroke();
    g.strokeStyle = c.ink; g.lineWidth = 1.6; g.beginPath(); g.moveTo(...spot(p)); g.lineTo(...spot(p.map((x, d) => x + 1.5 * r * n[d]))); g.stroke();
  }
  // Where the target velocity leads in a fifth of a second.
  function arrow(g, pane, now, i, c) {
    const p = now.bodies[i], to = p.map((x, d) => x + 0.2 * (now.states[i][data.target_velocity + d] ?? 0));
    const [x, y, u, v] = [pane.x(...p), pane.y(...p), pane.x(...to), pane.y(...to)], length = Math.hypot(u - x, v - y);
    if (length < 4) return;
    const [a, b] = [(u - x) / length * 5, (v - y) / length * 5];
    g.strokeStyle = c.ink; g.fillStyle = c.ink; g.lineWidth = 1.4;
    g.beginPath(); g.moveTo(x, y); g.lineTo(u - a, v - b); g.stroke();
    g.beginPath(); g.moveTo(u, v); g.lineTo(u - 1.4 * a - 0.7 * b, v - 1.4 * b + 0.7 * a); g.lineTo(u - 1.4 * a + 0.7 * b, v - 1.4 * b - 0.7 * a); g.fill();
  }
  function legend(element) {
    const plain = name => `background:var(--${name})`, ring = name => `border:2px solid var(--${name})`, ball = "background:rgba(var(--ball-trail), .35)";
    const keys = [[plain("agent"), word.agents]];
    if (chain.includes("balls")) keys.push([`${ball};${ring("ball")}`, "ball"], [`${ball};${ring("agent")}`, `ball touched by its ${word.agents}`]);
    keys.push([ring("goal"), "landmark"], [plain("covered"), "covered landmark"], [plain("crash"), `${word.agents}s in contact`]);
    if (data.out !== null) keys.push([plain("soft"), `${data.out_name} ✕`]);
    if (data.up !== null) keys.push(["", `line on a ${word.agents}: its up axis`]);
    element.replaceChildren(...keys.map(([style, text]) => {
      const row = document.createElement("div"), key = document.createElement("span");
      key.className = "key"; key.style = style; row.append(...(style ? [key, ` ${text}`] : [text]));
      return row;
    }));
    return keys.length;
  }

  let grip = null;
  const place = event => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  const under = (x, y) => panes.find(({ box }) => x >= box[0] && x < box[0] + box[2] && y >= box[1] && y < box[1] + box[3]);
  canvas.onpointerdown = event => {
    const [x, y] = place(event);
    if (!under(x, y)?.turns) return;
    canvas.setPointerCapture(event.pointerId); grip = { x, y, ...angles };
  };
  canvas.onpointerup = canvas.onpointercancel = () => { grip = null; };
  canvas.onpointermove = event => {
    if (!view.episode) return;
    const [x, y] = place(event), pane = under(x, y), t = Math.floor(view.time), e = view.episode;
    canvas.style.cursor = grip ? "grabbing" : pane?.turns ? "grab" : "";
    if (grip) {
      angles = { turn: grip.turn - (x - grip.x) / 150, rise: Math.min(1.55, Math.max(0.03, grip.rise + (y - grip.y) / 150)) };
      view.changed();
      return;
    }
    let best = Infinity, found = null;
    for (let i = 0; pane && i < e.bodies; i++) {
      const p = [0, 1, 2].map(d => e.at(t, i, d)), d = Math.hypot(pane.x(...p) - x, pane.y(...p) - y);
      if (d >= best || d >= Math.max(10, (i < e.agents ? data.agent_radius : data.ball_radius) * pane.k(...p)) + 4) continue;
      // A ball belongs to the agent that was sent to it.
      best = d; found = i < e.agents ? i : Array.from({ length: e.agents }, (_, k) => k).find(k => e.first(chain[1]) + e.member(k, 1) === i) ?? null;
    }
    if (found !== view.hover) { view.hover = found; view.changed(); }
  };
  return view;
}
