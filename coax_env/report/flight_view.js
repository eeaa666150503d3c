// Replays flights in three dimensions: the measured machine, and simulations put onto it now and then.
// Axes: north, east, up [m]; poses are north, east, up, roll, pitch, heading (flight_view.py).
const TRAIL = 5;     // s of the measured path that are shown
const GRID = 1;      // m between the lines on the ground
const SEEN = 8;      // m of ground around the machine
const LEAST = 0.07;  // of the camera's distance: the radius at which a machine is drawn at least
const PAPER_HEIGHT = {scene: 240, strip: 60}; // px
const BODY = {       // of the rotor's radius, in body axes: forward, right, down
  hull: [[[0.5, 0, 0], [0, 0, 0.24]], [[0.5, 0, 0], [0, 0.2, 0]], [[0, 0.2, 0], [0, 0, 0.24]]], // ellipses
  tail: [[-0.4, 0, -0.02], [-1.15, 0, -0.06]],
  fin: [[-1, 0, -0.05], [-1.2, 0, -0.3], [-1.27, 0, -0.3], [-1.17, 0, 0.08]],
  skids: [-0.2, 0.2].map(y => [[-0.35, y, 0.36], [0.35, y, 0.36], [0.42, y, 0.3]]),
  legs: [-0.2, 0.2].flatMap(y => [-0.2, 0.2].map(x => [[x, 0.5 * y, 0.15], [x, y, 0.36]])),
};

const floats = text => new Float32Array(bytes(text).buffer);

function replayFlight(root) {
  const content = JSON.parse(root.querySelector('script').textContent);
  const [scene, strip] = root.querySelectorAll('canvas');
  const find = name => root.querySelector(`[data-part="${name}"]`);
  const [play, slider, clock, words] = ['play', 'time', 'clock', 'words'].map(find);
  const runs = content.runs.map(run => ({
    t: floats(run.t), begins: run.begins, measured: floats(run.measured),
    models: run.models.map(floats), room: run.room, start: run.start, most: run.most,
  }));
  const colours = content.colours;
  const camera = {turn: 0.6, rise: 0.36, zoom: 1};
  let run = runs[0], now = run.start, playing = false, last = 0, shown = colours.map(() => true);

  // --- where everything is at a time ---------------------------------------------------------------
  function frameAt(time) {
    let low = 0, high = run.t.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (run.t[middle] <= time) low = middle; else high = middle;
    }
    return run.t[high] <= time ? high : low;
  }
  const began = frame => run.begins.reduce((found, b) => b <= frame ? b : found, 0);
  function pose(track, frame, time, jumps) {
    const here = track.subarray(6 * frame, 6 * frame + 6);
    if (frame + 1 >= run.t.length || (jumps && run.begins.includes(frame + 1))) return [...here];
    const share = (time - run.t[frame]) / (run.t[frame + 1] - run.t[frame]);
    return [...here].map((value, i) => value + share * (track[6 * frame + 6 + i] - value));
  }
  const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);

  // --- the picture ---------------------------------------------------------------------------------
  const ink = () => theme().layout.font.color;
  const faint = () => dark.matches && !printing ? '#4a525c' : '#c4cad1';

  const drawnRadius = () => Math.max(content.radius, LEAST * run.room / camera.zoom);

  function fit(canvas) { // bitmap in the screen's own pixels
    const scale = Math.max(window.devicePixelRatio || 1, 2);
    const width = printing ? PAPER_WIDTH : canvas.clientWidth;
    const height = printing ? PAPER_HEIGHT[canvas.className] : canvas.clientHeight;
    if (canvas.width !== Math.round(width * scale)) canvas.width = Math.round(width * scale);
    if (canvas.height !== Math.round(height * scale)) canvas.height = Math.round(height * scale);
    const pen = canvas.getContext('2d');
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    return {pen, width, height};
  }

  function lens(centre, width, height) {
    const [ct, st] = [Math.cos(camera.turn), Math.sin(camera.turn)];
    const [cr, sr] = [Math.cos(camera.rise), Math.sin(camera.rise)];
    const away = run.room / camera.zoom, focus = Math.min(0.62 * width, 1.5 * height);
    return point => {
      const [n, e, u] = [point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]];
      const depth = away + cr * (ct * n + st * e) - sr * u;
      if (depth < 0.15) return null;
      const right = -st * n + ct * e, up = sr * (ct * n + st * e) + cr * u;
      return [width / 2 + focus * right / depth, 0.4 * height - focus * up / depth, depth];
    };
  }

  function line(pen, points, colour, thick, alpha = 1) {
    pen.strokeStyle = colour; pen.lineWidth = thick; pen.globalAlpha = alpha;
    pen.beginPath();
    let down = false;
    for (const point of points) {
      if (!point || Number.isNaN(point[0])) { down = false; continue; }
      if (down) pen.lineTo(point[0], point[1]); else pen.moveTo(point[0], point[1]);
      down = true;
    }
    pen.stroke();
    pen.globalAlpha = 1;
  }
  function fill(pen, points, colour, alpha) {
    if (points.some(point => !point)) return;
    pen.fillStyle = colour; pen.globalAlpha = alpha;
    pen.beginPath();
    points.forEach((point, i) => i ? pen.lineTo(point[0], point[1]) : pen.moveTo(point[0], point[1]));
    pen.fill();
    pen.globalAlpha = 1;
  }

  function ground(pen, see, centre) {
    const [n0, e0] = [Math.round(centre[0]), Math.round(centre[1])];
    for (let i = -SEEN; i <= SEEN; i += GRID) {
      for (let j = -SEEN; j < SEEN; j += GRID) {
        for (const ends of [[[i, j], [i, j + GRID]], [[j, i], [j + GRID, i]]]) {
          const [a, b] = ends.map(([n, e]) => see([n0 + n, e0 + e, 0]));
          const fade = 1 - Math.hypot(ends[0][0], ends[0][1]) / SEEN;
          if (a && b && fade > 0) line(pen, [a, b], faint(), 1.2, Math.min(1.3 * fade, 1));
        }
      }
    }
  }

  function machine(pen, see, at, colour, solid) {
    const [cf, sf] = [Math.cos(at[3]), Math.sin(at[3])];
    const [ct, st] = [Math.cos(at[4]), Math.sin(at[4])];
    const [cp, sp] = [Math.cos(at[5]), Math.sin(at[5])];
    const size = drawnRadius();
    const place = ([x, y, z]) => {
      const [u, v, w] = [x * size, y * size, z * size];
      return see([
        at[0] + ct * cp * u + (sf * st * cp - cf * sp) * v + (cf * st * cp + sf * sp) * w,
        at[1] + ct * sp * u + (sf * st * sp + cf * cp) * v + (cf * st * sp - sf * cp) * w,
        at[2] + st * u - sf * ct * v - cf * ct * w,
      ]);
    };
    const ellipse = (a, b, z) => Array.from({length: 41}, (_, k) => {
      const [c, s] = [Math.cos(k * Math.PI / 20), Math.sin(k * Math.PI / 20)];
      return [c * a[0] + s * b[0], c * a[1] + s * b[1], z + c * a[2] + s * b[2]];
    }).map(place);
    [...BODY.legs, ...BODY.skids].forEach(part => line(pen, part.map(place), colour, 1.3, solid));
    line(pen, BODY.tail.map(place), colour, 2.5, solid);
    fill(pen, BODY.fin.map(place), colour, solid);
    BODY.hull.forEach(([a, b]) => fill(pen, ellipse(a, b, 0), colour, solid));
    line(pen, [[0, 0, -0.2], [0, 0, -0.75]].map(place), colour, 2, solid);
    for (const z of [-0.45, -0.75]) {
      const disc = ellipse([1, 0, 0], [0, 1, 0], z);
      fill(pen, disc, colour, 0.22 * solid);
      line(pen, disc, colour, 1.5, solid);
    }
  }

  function shadow(pen, see, at, colour) {
    line(pen, [see([at[0], at[1], 0]), see(at)], colour, 1, 0.45);
    const rim = Array.from({length: 24}, (_, k) => see([
      at[0] + 0.5 * drawnRadius() * Math.cos(k * Math.PI / 12),
      at[1] + 0.5 * drawnRadius() * Math.sin(k * Math.PI / 12), 0]));
    fill(pen, rim, colour, 0.3);
  }

  function path(see, track, from, frame, end) {
    const points = [];
    for (let k = from; k <= frame; k++) points.push(see(track.subarray(6 * k, 6 * k + 3)));
    points.push(see(end));
    return points;
  }

  function compass(pen, width, height) {
    const [x, y, long] = [38, height - 44, 20];
    const tip = [x - Math.sin(camera.turn) * long, y - Math.cos(camera.turn) * long];
    line(pen, [[x, y], tip], ink(), 2, 0.7);
    pen.fillStyle = ink();
    pen.font = '600 14px system-ui, sans-serif';
    pen.textAlign = 'center'; pen.textBaseline = 'middle';
    pen.fillText('N', x - Math.sin(camera.turn) * (long + 10), y - Math.cos(camera.turn) * (long + 10));
    pen.font = '14px system-ui, sans-serif';
    pen.textAlign = 'right'; pen.textBaseline = 'alphabetic'; pen.globalAlpha = 0.7;
    const larger = drawnRadius() / content.radius;
    const words = larger > 1.05 ? `, machines × ${larger.toFixed(1)}` : '';
    pen.fillText('grid 1 m' + words, width - 12, height - 12);
    pen.globalAlpha = 1;
  }

  function picture() {
    const {pen, width, height} = fit(scene);
    const frame = frameAt(now), first = began(frame);
    const real = pose(run.measured, frame, now, false);
    const ghosts = run.models.map(track => pose(track, frame, now, true));
    const see = lens(real, width, height);
    ground(pen, see, real);
    const old = Math.max(frameAt(now - TRAIL), 0);
    line(pen, path(see, run.measured, old, frame, real), content.measured, 2.5, 0.75);
    shadow(pen, see, real, ink());
    const drawn = [];
    ghosts.forEach((ghost, i) => {
      if (!shown[i] || Number.isNaN(ghost[0])) return;
      shadow(pen, see, ghost, colours[i]);
      line(pen, path(see, run.models[i], first, frame, ghost), colours[i], 2.5);
      pen.setLineDash([3, 4]);
      line(pen, [see(real), see(ghost)], colours[i], 1.5, 0.9);
      pen.setLineDash([]);
      drawn.push([see(ghost), () => machine(pen, see, ghost, colours[i], 0.8)]);
    });
    drawn.push([see(real), () => machine(pen, see, real, content.measured, 1)]);
    drawn.sort((a, b) => (b[0] ? b[0][2] : 0) - (a[0] ? a[0][2] : 0)).forEach(([, it]) => it());
    compass(pen, width, height);
    clock.textContent = `${(now - run.t[0]).toFixed(1)} s`;
    words.textContent = ghosts.map((ghost, i) => {
      const off = distance(ghost, real);
      return `${content.names[i]} ${Number.isNaN(off) ? 'ran away' : off.toFixed(2) + ' m off'}`;
    }).join(', ');
  }

  function errors() { // distance from the measured path over time, under the picture
    const {pen, width, height} = fit(strip);
    const [t0, t1] = [run.t[0], run.t[run.t.length - 1]];
    const x = time => (time - t0) / (t1 - t0) * width;
    const y = off => height - 2 - Math.min(off / run.most, 1.05) * (height - 22);
    line(pen, [[0, y(0)], [width, y(0)]], faint(), 1);
    run.models.forEach((track, i) => {
      if (!shown[i]) return;
      const points = [];
      run.t.forEach((time, k) => {
        if (run.begins.includes(k)) points.push(null);
        points.push([x(time), y(distance(track.subarray(6 * k), run.measured.subarray(6 * k)))]);
      });
      line(pen, points, colours[i], 1.8);
    });
    line(pen, [[x(now), 0], [x(now), height]], ink(), 1.5);
    pen.fillStyle = ink();
    pen.font = '14px system-ui, sans-serif';
    pen.textAlign = x(now) > width / 2 ? 'left' : 'right';
    pen.fillText(`distance, up to ${run.most.toPrecision(2)} m`, x(now) > width / 2 ? 2 : width - 2, 14);
  }

  function show() { slider.value = now; picture(); errors(); }

  // --- the controls --------------------------------------------------------------------------------
  function tick(moment) {
    if (!playing) return;
    now += Math.min((moment - last) / 1000, 0.1) * Number(find('speed').value);
    last = moment;
    if (now >= run.t[run.t.length - 1]) { now = run.t[run.t.length - 1]; run_on(false); }
    show();
    requestAnimationFrame(tick);
  }
  function run_on(on) {
    playing = on;
    play.textContent = on ? 'Pause' : 'Play';
    if (!on) return;
    if (now >= run.t[run.t.length - 1]) now = run.t[0];
    last = performance.now();
    requestAnimationFrame(tick);
  }
  function choose(index) {
    run = runs[index];
    now = run.start;
    const frame = frameAt(now), real = pose(run.measured, frame, now), ghost = pose(run.models[0], frame, now);
    if (distance(real, ghost) > 0.1) // seen from the side on which they part
      camera.turn = Math.atan2(ghost[1] - real[1], ghost[0] - real[0]) + 1.25;
    slider.min = run.t[0];
    slider.max = run.t[run.t.length - 1];
    show();
  }
  play.addEventListener('click', () => run_on(!playing));
  slider.addEventListener('input', () => { run_on(false); now = Number(slider.value); show(); });
  find('run').addEventListener('change', event => choose(event.target.selectedIndex));
  root.querySelectorAll('[data-model]').forEach(box => box.addEventListener('change', () => {
    shown[Number(box.dataset.model)] = box.checked;
    show();
  }));
  root.querySelectorAll('[data-zoom]').forEach(button => button.addEventListener('click', () => {
    zoom(Number(button.dataset.zoom));
  }));
  function zoom(factor) {
    camera.zoom = Math.min(Math.max(camera.zoom * factor, 0.3), 4);
    picture();
  }

  const fingers = new Map();
  scene.addEventListener('pointerdown', event => {
    fingers.set(event.pointerId, event);
    scene.setPointerCapture(event.pointerId);
  });
  scene.addEventListener('pointermove', event => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    if (fingers.size === 1) {
      camera.turn += (event.offsetX - before.offsetX) * 0.008;
      camera.rise = Math.min(Math.max(camera.rise + (event.offsetY - before.offsetY) * 0.006, 0), 1.5);
    } else {
      const [other] = [...fingers.values()].filter(one => one.pointerId !== event.pointerId);
      const gap = one => Math.hypot(one.offsetX - other.offsetX, one.offsetY - other.offsetY);
      zoom(gap(event) / Math.max(gap(before), 1));
    }
    fingers.set(event.pointerId, event);
    picture();
  });
  for (const over of ['pointerup', 'pointercancel'])
    scene.addEventListener(over, event => fingers.delete(event.pointerId));
  strip.addEventListener('pointerdown', event => { strip.setPointerCapture(event.pointerId); scrub(event); });
  strip.addEventListener('pointermove', event => { if (event.buttons) scrub(event); });
  function scrub(event) {
    run_on(false);
    const share = Math.min(Math.max(event.offsetX / strip.clientWidth, 0), 1);
    now = run.t[0] + share * (run.t[run.t.length - 1] - run.t[0]);
    show();
  }

  restyled.push(show);
  new ResizeObserver(show).observe(scene);
  choose(0);
}
document.querySelectorAll('.flight').forEach(replayFlight);
