// @ts-check
'use strict';
/* Draws the numbers of the page with Plotly; the slider moves everything to one instant. */

/** @typedef {(number|null)[]} Curve */
/** @type {any} */
const Plotly = /** @type {any} */ (globalThis).Plotly;
/** @type {any} */
const run = JSON.parse(/** @type {HTMLElement} */ (document.getElementById('numbers')).textContent || '{}');

/* Okabe and Ito: distinct for all kinds of colour vision. */
const BLUE = '#0072b2', SKY = '#56b4e9', ORANGE = '#e69f00', RED = '#d55e00', GREEN = '#009e73', PINK = '#cc79a7';
const HEIGHTS = { large: 200, small: 130 };
/* What fits on a page of A4 or Letter; the browser says it is printing before it has the page's width. */
const PAPER = { width: 680, map: 400, side: 330 };
const dark = matchMedia('(prefers-color-scheme: dark)');
let printing = false;
/* A figure that is saved is for paper, too, in the size that it has on the screen. */
let saving = false;

/** @param {string} id @returns {HTMLElement} */
const element = (id) => /** @type {HTMLElement} */ (document.getElementById(id));
const slider = /** @type {HTMLInputElement} */ (element('slider'));

function isDark() { return dark.matches && !printing && !saving; }
function ink() { return isDark() ? '#e6e9ee' : '#1b1f24'; }
/* From blue to yellow, as Cividis; small values stay visible on paper and in the dark. */
function scale() { return isDark() ? [[0, '#4a74b5'], [0.5, '#9c9a8e'], [1, '#ffe945']] : [[0, '#f0d84a'], [0.5, '#7c7b78'], [1, '#00204d']]; }
function background() { return saving ? '#ffffff' : 'rgba(0,0,0,0)'; }
function grid() { return isDark() ? '#39404a' : '#d5d9de'; }

/* Half-axis of the ellipse that holds 95 % in a plane, in standard deviations. */
const SIGMAS = Math.sqrt(5.991464547);

/** Two directions of the world, on which all is projected. @typedef {{across: number[], up: number[]}} View */
/** @type {View} */
const PLAN = { across: [1, 0, 0], up: [0, 1, 0] };

/** Seen from the side, from a direction in the plane and from above it. @param {number} turn degrees @param {number} tilt degrees @returns {View} */
function sideView(turn, tilt) {
  const [a, e] = [turn * Math.PI / 180, tilt * Math.PI / 180];
  return { across: [Math.cos(a), Math.sin(a), 0], up: [-Math.sin(a) * Math.sin(e), Math.cos(a) * Math.sin(e), Math.cos(e)] };
}

/** @param {number[]} one @param {number[]} other */
const dot = (one, other) => one[0] * other[0] + one[1] * other[1] + one[2] * other[2];

/** Projects many points. @param {Curve[]} xyz @param {number[]} direction @returns {Curve} */
function along(xyz, direction) {
  return xyz[0].map((x, n) => (x === null ? null : dot([x, /** @type {number} */ (xyz[1][n]), /** @type {number} */ (xyz[2][n])], direction)));
}

/** Points of the ellipse that a covariance has in a view, then a gap. @param {number} x @param {number} y @param {number[]} upper @param {View} view @param {Curve} xs @param {Curve} ys */
function addEllipse(x, y, [xx, xy, xz, yy, yz, zz], view, xs, ys) {
  /** @param {number[]} v */
  const times = (v) => [dot([xx, xy, xz], v), dot([xy, yy, yz], v), dot([xz, yz, zz], v)];
  const P = times(view.across), Q = times(view.up);
  const a = dot(P, view.across), b = dot(P, view.up), c = dot(Q, view.up);
  /* A root of the covariance in the plane takes a circle to its ellipse. */
  const first = Math.sqrt(Math.max(a, 0)), skew = first > 0 ? b / first : 0, second = Math.sqrt(Math.max(c - skew * skew, 0));
  for (let i = 0; i <= 24; i += 1) {
    const u = SIGMAS * Math.cos(i * Math.PI / 12), v = SIGMAS * Math.sin(i * Math.PI / 12);
    xs.push(x + first * u);
    ys.push(y + skew * u + second * v);
  }
  xs.push(null);
  ys.push(null);
}

/** What moves with the slider. @param {number} i instant @param {View} view */
function stateAt(i, view) {
  const { xyz, ahead, robot, points, covariances, in_doubt } = run.instants;
  const [x, y] = [dot(xyz[i], view.across), dot(xyz[i], view.up)];
  const px = along(points[i], view.across), py = along(points[i], view.up);
  /** @type {Curve} */ const ex = [];
  /** @type {Curve} */ const ey = [];
  (covariances[i] || []).forEach((/** @type {number[]} */ upper, /** @type {number} */ n) => addEllipse(/** @type {number} */ (px[n]), /** @type {number} */ (py[n]), upper, view, ex, ey));
  /** @type {Curve} */ const rx = [];
  /** @type {Curve} */ const ry = [];
  if (robot[i]) addEllipse(x, y, robot[i][0], view, rx, ry);
  const length = 0.04 * extent;
  /* Distances alone are circles about their landmarks, in the plan; directions alone are lines. */
  /** @type {Curve} */ const hx = [];
  /** @type {Curve} */ const hy = [];
  if (view === PLAN) {
    run.instants.rings[i].forEach((/** @type {number[]} */ [cx, cy, radius]) => {
      for (let n = 0; n <= 360; n += 1) {
        const x = cx + radius * Math.cos(n * Math.PI / 180), y = cy + radius * Math.sin(n * Math.PI / 180);
        const isShown = ground[0][0] <= x && x <= ground[0][1] && ground[1][0] <= y && y <= ground[1][1];
        hx.push(isShown ? x : null);
        hy.push(isShown ? y : null);
      }
      hx.push(null);
      hy.push(null);
    });
  }
  run.instants.rays[i].forEach((/** @type {number[]} */ end) => {
    hx.push(x, dot(end, view.across), null);
    hy.push(y, dot(end, view.up), null);
  });
  /** @param {Curve} all */
  const doubted = (all) => in_doubt[i].map((/** @type {number} */ n) => all[n]);
  return {
    x: [px, ex, rx, [x, x + length * dot(ahead[i], view.across)], hx, doubted(px), [x]],
    y: [py, ey, ry, [y, y + length * dot(ahead[i], view.up)], hy, doubted(py), [y]],
    text: [run.instants.ids[i].map((/** @type {number} */ id) => String(id)), null, null, null, null, null, null],
  };
}

/** Least and largest of some numbers. @param {Curve} values @returns {number[]} */
function span(values) {
  const known = /** @type {number[]} */ (values.filter((v) => v !== null));
  return known.length ? [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))] : [0, 1];
}

const extent = Math.max(...[0, 1].map((k) => { const [least, most] = span(run.path.xyz[k]); return most - least; }), 0.1);
/* Where the robot and the landmarks are: whole circles about far ones would make all else small. */
const ground = [0, 1].map((k) => span([run.path.xyz, ...run.instants.points.slice(-1)].flatMap((xyz) => xyz[k])));

const hasDoubts = run.instants.in_doubt.some((/** @type {any[]} */ each) => each.length > 0);
const hasHalves = [...run.instants.rings, ...run.instants.rays].some((/** @type {any[]} */ each) => each.length > 0);

/** @param {boolean} isPlan @param {View} view */
function mapFigure(isPlan, view) {
  const path = run.path, first = stateAt(Number(slider.value), view);
  const traces = [];
  if (path.true_xyz) {
    traces.push({ x: along(path.true_xyz, view.across), y: along(path.true_xyz, view.up), mode: 'lines', name: 'truth, aligned', line: { color: ink(), width: 1, dash: 'dot' }, hoverinfo: 'skip' });
  }
  const bar = { title: { text: path.error_m ? 'error [m]' : 'time [s]', side: 'right' }, thickness: 12, len: 0.8 };
  const colours = { color: path.error_m || path.t, colorscale: scale(), size: 4, showscale: isPlan, colorbar: bar };
  traces.push({
    x: along(path.xyz, view.across), y: along(path.xyz, view.up), mode: 'markers', name: 'estimate', marker: colours, customdata: path.t,
    text: path.error_m ? path.error_m.map((/** @type {number|null} */ e) => (e === null ? 'no truth' : `${e.toFixed(2)} m off`)) : path.t,
    hovertemplate: '%{customdata:.1f} s, %{text}<extra></extra>',
  });
  if (run.true_landmarks) {
    traces.push({ x: along(run.true_landmarks.xyz, view.across), y: along(run.true_landmarks.xyz, view.up), mode: 'markers', name: 'true landmarks', marker: { symbol: 'x-thin', size: 9, line: { color: ink(), width: 1.5 } }, text: run.true_landmarks.ids, hovertemplate: 'true landmark %{text}<extra></extra>' });
  }
  if (run.smoothed) {
    const { xyz, points } = run.smoothed;
    traces.push({ x: along(xyz, view.across), y: along(xyz, view.up), mode: 'lines', name: 'smoothed', line: { color: PINK, width: 1.5 }, hoverinfo: 'skip' });
    traces.push({ x: along(points, view.across), y: along(points, view.up), mode: 'markers', name: 'landmarks, smoothed', marker: { symbol: 'circle-open', size: 10, color: PINK }, hoverinfo: 'skip' });
  }
  const still = traces.length;
  traces.push(
    { x: first.x[0], y: first.y[0], text: first.text[0], mode: 'markers+text', textposition: 'top right', name: 'landmarks', marker: { symbol: 'square', size: 7, color: GREEN }, hovertemplate: 'landmark %{text}<extra></extra>' },
    { x: first.x[1], y: first.y[1], mode: 'lines', name: '95 %, landmarks', line: { color: GREEN, width: 1.5 }, hoverinfo: 'skip' },
    { x: first.x[2], y: first.y[2], mode: 'lines', name: '95 %, robot', line: { color: RED, width: 2 }, hoverinfo: 'skip' },
    { x: first.x[3], y: first.y[3], mode: 'lines', showlegend: false, line: { color: RED, width: 3 }, hoverinfo: 'skip' },
    { x: first.x[4], y: first.y[4], mode: 'lines', name: 'distances, directions', showlegend: hasHalves, line: { color: SKY, width: 1 }, hoverinfo: 'skip' },
    { x: first.x[5], y: first.y[5], mode: 'markers', name: 'elsewhere in another map that fits', showlegend: hasDoubts, marker: { symbol: 'diamond-open', size: 14, color: PINK, line: { width: 2 } }, hoverinfo: 'skip' },
    { x: first.x[6], y: first.y[6], mode: 'markers', name: 'robot', marker: { size: 10, color: RED, line: { color: '#fff', width: 1 } }, hoverinfo: 'skip' },
  );
  const axis = { gridcolor: grid(), zeroline: false, automargin: true };
  /** @type {any} */
  const layout = {
    paper_bgcolor: background(), plot_bgcolor: 'rgba(0,0,0,0)', font: { color: ink() },
    margin: { l: 50, r: 10, t: 10, b: 40 }, legend: { orientation: 'h', y: 1.02, yanchor: 'bottom', x: 0.5, xanchor: 'center' },
    xaxis: { ...axis, title: { text: axisName(view.across, 'across') }, constrain: 'domain' },
    yaxis: { ...axis, title: { text: axisName(view.up, 'up') }, scaleanchor: 'x', constrain: 'domain' },
    hovermode: 'closest', uirevision: 'kept', showlegend: isPlan,
    ...(printing ? { width: PAPER.width, height: isPlan ? PAPER.map : PAPER.side } : {}),
  };
  return { data: traces, layout, still };
}

/* The buttons below a figure save it as it is for paper; Plotly's own would keep the colours of the night. */
function plotSettings() {
  return { responsive: !printing, displaylogo: false, modeBarButtonsToRemove: ['toImage'], displayModeBar: matchMedia('(hover: hover)').matches && !printing ? undefined : false };
}

/** @param {string} id @param {View} view */
function drawMap(id, view) {
  const { data, layout, still } = mapFigure(id === 'map', view);
  Plotly.newPlot(id, data, layout, plotSettings());
  element(id).dataset.still = String(still);
  /** @type {any} */ (element(id)).on('plotly_click', (/** @type {any} */ event) => {
    const { customdata: t, data, text } = event.points[0];
    if (typeof t === 'number') goTo(t);
    if (data.name === 'landmarks') showLife(Number(text));
  });
}

/** @param {number[]} direction @param {string} otherwise */
function axisName(direction, otherwise) {
  const n = direction.findIndex((share) => share > 0.9999);
  return `${n < 0 ? otherwise : 'xyz'[n]} [m]`;
}

/** The view that the two sliders below the side view give. */
function chosenView() {
  return sideView(Number(/** @type {HTMLInputElement} */ (element('turn')).value), Number(/** @type {HTMLInputElement} */ (element('tilt')).value));
}

/** What observations alone show, and no line across the time without any. @param {number[]} t @param {Curve} y @returns {Curve[]} */
function interrupted(t, y) {
  /** @type {Curve[]} */ const [xs, ys] = [[], []];
  t.forEach((now, n) => {
    if (n && run.gaps.some((/** @type {number[]} */ [begin, end]) => t[n - 1] < end && begin < now && end - begin > 0.5 * (now - t[n - 1]))) {
      xs.push(null);
      ys.push(null);
    }
    xs.push(now);
    ys.push(y[n]);
  });
  return [xs, ys];
}

/** @typedef {{title: string, traces: any[], axis?: any, small?: boolean}} Row */

/** One legend entry inside the row it belongs to: the name is written at the curve's row title.
 * @returns {Row[]} */
function rows() {
  const { errors, consistency, residuals } = run;
  /** @param {any} x @param {any} y @param {string} name @param {any} line */
  const curve = (x, y, name, line) => ({ x, y, name, mode: 'lines', line: { width: 1.6, ...line } });
  /** @type {Row[]} */
  const all = [];
  const position = [];
  if (run.path.error_m) position.push(curve(run.path.t, run.path.error_m, 'error, aligned as for the ATE', { color: BLUE }));
  if (errors.drift_m) position.push(curve(errors.t, errors.drift_m, 'error from the first pose on', { color: RED }));
  if (errors.smoothed_m) position.push(curve(errors.smoothed_t, errors.smoothed_m, 'error of the smoothed path, aligned', { color: PINK }));
  position.push(curve(errors.t, errors.bound_m, 'stated 95 %, from the first pose on', { color: ink(), dash: 'dash' }));
  all.push({ title: 'position [m]', traces: position, axis: { rangemode: 'tozero' } });
  const heading = [];
  if (errors.heading_deg) heading.push(curve(errors.heading_t, errors.heading_deg, 'error of the heading, aligned', { color: BLUE }));
  if (errors.smoothed_heading_deg) heading.push(curve(errors.smoothed_t, errors.smoothed_heading_deg, 'smoothed', { color: PINK }));
  if (heading.length) all.push({ title: 'heading [°]', traces: heading });
  if (errors.configuration_m) {
    const [t, off] = interrupted(errors.configuration_t, errors.configuration_m);
    all.push({ title: 'configuration [m]', small: true, traces: [{ ...curve(t, off, 'error of the landmarks as the robot sees them, not aligned', { color: GREEN }), mode: 'lines+markers', marker: { size: 2.5, color: GREEN } }], axis: { rangemode: 'tozero' } });
  }
  const ids = residuals.id;
  const moved = new Set(residuals.moved);
  /** @param {(w: number, i: number) => boolean} test @param {any} y @param {string} name @param {any} marker */
  const some = (test, y, name, marker) => {
    const rows = residuals.weight.map((/** @type {number} */ w, /** @type {number} */ i) => i).filter((/** @type {number} */ i) => test(residuals.weight[i], i));
    return { x: rows.map((/** @type {number} */ i) => residuals.t[i]), y: rows.map((/** @type {number} */ i) => y(i)), text: rows.map((/** @type {number} */ i) => `landmark ${ids[i]}: ${residuals.sigma[i]} σ`), customdata: rows.map((/** @type {number} */ i) => ids[i]), name, mode: 'markers', marker, hovertemplate: '%{text}<extra></extra>' };
  };
  const known = residuals.sigma.some((/** @type {number} */ s) => s > 0);
  /** @param {any} y @param {boolean} legend */
  const kinds = (y, legend) => [
    some((w, i) => w === 1 && !moved.has(i), y, 'used', { color: SKY, size: 4 }),
    some((w, i) => w > 0 && w < 1 && !moved.has(i), y, 'down-weighted', { color: ORANGE, size: 6, symbol: 'triangle-up' }),
    some((w, i) => w === 0 && !moved.has(i), y, 'rejected', { color: RED, size: 8, symbol: 'x' }),
    some((_, i) => moved.has(i), y, 'believed moved', { color: PINK, size: 11, symbol: 'star' }),
  ].filter((trace) => trace.x.length).map((trace, n) => ({ ...trace, showlegend: legend, legendgroup: `kind${n}` }));
  if (known) {
    all.push({ title: 'residual [σ]', traces: kinds((/** @type {number} */ i) => Math.max(residuals.sigma[i], 0.1), true), axis: { type: 'log', range: [-1, Math.max(1, Math.log10(1.2 * Math.max(...residuals.sigma, 1)))], dtick: 1 } });
  }
  const names = [...new Set(ids)].sort((a, b) => Number(a) - Number(b));
  all.push({ title: 'landmark seen', traces: kinds((/** @type {number} */ i) => names.indexOf(ids[i]), !known), axis: { tickvals: names.map((_, i) => i), ticktext: names.map(String), showgrid: names.length <= 40, range: [-0.7, names.length - 0.3], nticks: 20, tickfont: { size: names.length > 12 ? 9 : 11 } } });
  const fit = [];
  if (consistency.nis) {
    const [t, nis] = interrupted(consistency.nis_t, consistency.nis);
    fit.push(
      { ...curve(consistency.nis_t, consistency.nis_low, 'low', { width: 0 }), showlegend: false, hoverinfo: 'skip' },
      { ...curve(consistency.nis_t, consistency.nis_high, `95 % of NIS if all noise is as stated`, { width: 0 }), fill: 'tonexty', fillcolor: 'rgba(0,158,115,0.25)', hoverinfo: 'skip' },
      curve(t, nis, `NIS per degree of freedom, means of ${consistency.nis_group}`, { color: GREEN, width: 0.8 }),
    );
    fit[2].mode = 'lines+markers';
    fit[2].marker = { size: 4, color: GREEN };
  }
  if (consistency.nees) {
    fit.push(curve(consistency.nees_t, consistency.nees, 'NEES of the pose per degree of freedom', { color: PINK }));
    for (const limit of consistency.nees_band) {
      fit.push({ ...curve([run.errors.t[0], run.errors.t[run.errors.t.length - 1]], [limit, limit], '95 % of NEES', { color: PINK, dash: 'dot', width: 1 }), showlegend: limit === consistency.nees_band[1], hoverinfo: 'skip' });
    }
  }
  if (fit.length) all.push({ title: 'NIS, NEES', traces: fit, axis: { type: 'log', dtick: 1 } });
  for (const part of run.calibration) {
    const x = part.t, up = part.value.map((/** @type {number} */ v, /** @type {number} */ i) => v + part.deviation[i]);
    const down = part.value.map((/** @type {number} */ v, /** @type {number} */ i) => v - part.deviation[i]);
    all.push({
      title: `${part.name.replaceAll('_', ' ')}${part.unit ? `<br>[${part.unit}]` : ''}`, small: true,
      traces: [
        { ...curve(x, down, 'down', { width: 0 }), showlegend: false, hoverinfo: 'skip' },
        { ...curve(x, up, '± σ', { width: 0 }), fill: 'tonexty', fillcolor: 'rgba(86,180,233,0.35)', showlegend: false, hoverinfo: 'skip' },
        { ...curve(x, part.value, part.name, { color: BLUE }), showlegend: false },
        { ...curve([x[0], x[x.length - 1]], [part.nominal, part.nominal], 'nominal', { color: ink(), dash: 'dot', width: 1 }), showlegend: false },
      ],
    });
  }
  all.push({ title: 'log10 L', small: true, traces: [{ ...curve(errors.lyapunov_t, errors.lyapunov, 'log10 L', {}), mode: 'markers', marker: { color: BLUE, size: 3 }, showlegend: false }] });
  if (run.drops.length) {
    all.push({ title: 'dropped', small: true, traces: run.drops.map((/** @type {any} */ drop, /** @type {number} */ n) => ({ ...curve(errors.t, drop.count, `dropped: ${drop.reason}`, { color: [RED, BLUE, ORANGE, GREEN, PINK, SKY][n % 6], shape: 'hv' }) })), axis: { rangemode: 'tozero' } });
  }
  return all;
}

/** One figure of all rows on the screen, where they are zoomed together; on paper one each, as pages end between figures. */
function drawCurves() {
  const all = rows(), place = element('curves');
  Plotly.purge(place);
  place.replaceChildren();
  if (printing) {
    all.forEach((row) => drawRows(place.appendChild(document.createElement('div')), [row]));
    return;
  }
  drawRows(place, all);
  /** @type {any} */ (place).on('plotly_click', (/** @type {any} */ event) => {
    goTo(event.points[0].x);
    if (typeof event.points[0].customdata === 'number') showLife(event.points[0].customdata);
  });
}

/** @param {HTMLElement} place @param {Row[]} all */
function drawRows(place, all) {
  const { data, layout } = rowsFigure(place, all);
  Plotly.newPlot(place, data, layout, plotSettings());
}

/** @param {HTMLElement} place @param {Row[]} all */
function rowsFigure(place, all) {
  const narrow = place.clientWidth < 700;
  /* Above each row there is room for its legend, a line for each name where they don't fit into one. */
  const spaces = all.map((row) => 28 + 18 * (narrow ? row.traces.filter((trace) => trace.showlegend !== false).length : 1));
  const heights = all.map((row) => (row.small ? HEIGHTS.small : HEIGHTS.large));
  const total = heights.reduce((a, b, n) => a + b + spaces[n], 0);
  const end = run.errors.t[run.errors.t.length - 1] || 1;
  const now = run.instants.t[Number(slider.value)] || 0;
  /** @type {any} */
  const layout = {
    height: total + 44, ...(printing ? { width: PAPER.width } : {}), paper_bgcolor: background(), plot_bgcolor: 'rgba(0,0,0,0)', font: { color: ink(), size: 12 },
    margin: { l: 62, r: 12, t: 4, b: 40 }, hovermode: 'closest', uirevision: 'kept',
    xaxis: { gridcolor: grid(), zeroline: false, title: { text: 'time [s]' }, anchor: `y${all.length > 1 ? all.length : ''}`, range: [0, end] },
    shapes: [{ type: 'line', xref: 'x', yref: 'paper', x0: now, x1: now, y0: 0, y1: 1, line: { color: RED, width: 1.5 } }].concat(run.gaps.map((/** @type {number[]} */ gap) => ({ type: 'rect', xref: 'x', yref: 'paper', x0: gap[0], x1: gap[1], y0: 0, y1: 1, line: { width: 0 }, fillcolor: 'rgba(128,128,128,0.18)', layer: 'below' }))),
  };
  /** @type {any[]} */
  const traces = [];
  let top = 0;
  all.forEach((row, n) => {
    const name = n ? String(n + 1) : '';
    top += spaces[n];
    const y1 = 1 - top / total, y0 = 1 - (top + heights[n]) / total;
    layout[`yaxis${name}`] = { domain: [Math.max(y0, 0), y1], gridcolor: grid(), zeroline: false, title: { text: row.title, font: { size: 11 } }, ...row.axis };
    layout[`legend${name}`] = { orientation: 'h', x: 0, y: y1, yanchor: 'bottom', bgcolor: 'rgba(0,0,0,0)', font: { size: 11 } };
    row.traces.forEach((trace) => traces.push({ ...trace, xaxis: 'x', yaxis: `y${name}`, legend: `legend${name}` }));
    top += heights[n];
  });
  return { data: traces, layout };
}

/** Saves a figure as it is zoomed and chosen on the screen, black on white. @param {string} id @param {string} format */
function save(id, format) {
  const place = /** @type {any} */ (element(id));
  saving = true;
  const { data, layout } = id === 'curves' ? rowsFigure(place, rows()) : mapFigure(id === 'map', id === 'map' ? PLAN : chosenView());
  saving = false;
  data.forEach((/** @type {any} */ trace, /** @type {number} */ n) => { trace.visible = place.data[n].visible; });
  for (const axis of Object.keys(layout).filter((name) => /^[xy]axis/.test(name))) {
    layout[axis] = { ...layout[axis], range: [...place.layout[axis].range] };
  }
  const filename = `${run.title.replace(/\.[^.]*$/, '')}_${id}`;
  return Plotly.downloadImage({ data, layout }, { format, width: place.clientWidth, height: place.clientHeight, scale: format === 'png' ? 3 : 1, filename });
}

/** @param {number} t seconds */
function goTo(t) {
  const times = run.instants.t;
  let best = 0;
  times.forEach((/** @type {number} */ time, /** @type {number} */ i) => { if (Math.abs(time - t) < Math.abs(times[best] - t)) best = i; });
  slider.value = String(best);
  show();
}

let due = false;
function show() {
  if (due) return;
  due = true;
  setTimeout(() => { due = false; update(); }, 16);
}

function update() {
  const i = Number(slider.value), t = run.instants.t[i];
  if (t === undefined) return;
  [['map', PLAN], ['side', chosenView()]].forEach(([id, view]) => {
    const place = element(String(id));
    if (!place.dataset.still) return;
    const still = Number(place.dataset.still), state = stateAt(i, /** @type {View} */ (view));
    Plotly.restyle(place, { x: state.x, y: state.y, text: state.text.map((text) => text || '') }, [0, 1, 2, 3, 4, 5, 6].map((n) => still + n));
  });
  if (printing) return;
  Plotly.relayout('curves', { 'shapes[0].x0': t, 'shapes[0].x1': t });
  const near = run.path.t.reduce((/** @type {number} */ a, /** @type {number} */ time, /** @type {number} */ k) => (Math.abs(time - t) < Math.abs(run.path.t[a] - t) ? k : a), 0);
  const error = run.path.error_m ? run.path.error_m[near] : null;
  const bound = run.errors.bound_m[run.errors.t.indexOf(t)];
  const parts = [`${t.toFixed(1)} s`, `${run.instants.ids[i].length} landmarks`];
  if (error !== null && error !== undefined) parts.push(`position ${error.toPrecision(2)} m off (aligned)`);
  if (bound !== null && bound !== undefined) parts.push(`stated 95 %: ${bound.toFixed(2)} m`);
  if (run.gaps.some((/** @type {number[]} */ gap) => gap[0] <= t && t <= gap[1])) parts.push('sees no landmark it can use');
  element('readout').textContent = parts.join(' · ');
  slider.setAttribute('aria-valuetext', parts.join(', '));
}

/** @param {string} id @param {string[]} head @param {any[][]} body */
function fillTable(id, head, body) {
  const table = /** @type {HTMLTableElement} */ (element(id));
  if (head.length) {
    const row = table.createTHead().insertRow();
    head.forEach((text, n) => { const cell = document.createElement('th'); cell.textContent = text; if (body[0] && typeof body[0][n] === 'number') cell.className = 'number'; row.append(cell); });
  }
  const rows = table.createTBody();
  body.forEach((values) => {
    const row = rows.insertRow();
    values.forEach((value) => { const cell = row.insertCell(); cell.textContent = value === null ? '–' : String(value); if (typeof value === 'number') cell.className = 'number'; });
  });
}

/** What came of each observation of a landmark, and of the landmark itself, by time. @param {number} id */
function showLife(id) {
  const { residuals, outcomes } = run, moved = new Set(residuals.moved);
  /** @type {any[][]} */
  const lines = [];
  residuals.id.forEach((/** @type {number} */ other, /** @type {number} */ i) => {
    const weight = residuals.weight[i];
    let what = weight === 0 ? 'rejected' : weight < 1 ? `used with weight ${weight}` : 'used';
    if (moved.has(i)) what += ', believed moved';
    if (other === id) lines.push([residuals.t[i], residuals.sigma[i], residuals.m[i], what]);
  });
  outcomes.id.forEach((/** @type {number} */ other, /** @type {number} */ i) => {
    if (other === id) lines.push([outcomes.t[i], null, null, outcomes.what[i]]);
  });
  lines.sort((a, b) => a[0] - b[0]);
  const section = element('life');
  section.hidden = false;
  const left_out = residuals.left_out ? '; of a long run some residuals are left out' : '';
  /** @type {HTMLElement} */ (section.querySelector('h2')).textContent = `Landmark ${id}${left_out}`;
  const table = document.createElement('table');
  table.id = 'life-table';
  /** @type {HTMLElement} */ (section.querySelector('table')).replaceWith(table);
  fillTable('life-table', ['time [s]', 'residual [σ]', 'residual [m]', 'what came of it'], lines);
  section.scrollIntoView({ behavior: 'smooth', block: 'nearest' });
}

function write() {
  document.title = run.title;
  element('title').textContent = run.title;
  const list = /** @type {HTMLElement} */ (element('findings').querySelector('ol'));
  run.findings.forEach((/** @type {any} */ finding) => {
    const item = document.createElement('li');
    if (finding.end_s === null) {
      item.textContent = finding.text;
    } else {
      const button = document.createElement('button');
      button.textContent = finding.text;
      button.addEventListener('click', () => goTo(finding.end_s));
      item.append(button);
    }
    list.append(item);
  });
  if (!run.findings.length) element('findings').hidden = true;
  element('map-note').textContent = run.path.true_xyz ? 'The estimate as it was at each moment; its colour is the distance from the truth, aligned with the whole run.' : 'The estimate as it was at each moment. The recording holds no truth to compare it with.';
  if (run.errors.bound_m.some((/** @type {number|null} */ b) => b !== null)) element('map-note').textContent += ' Ellipses hold 95 %; they count from the first pose, from where everything is mapped.';
  fillTable('landmarks', ['id', 'observed', 'rejected', 'down-weighted', 'believed moved', 'residual RMS [m]', 'residual RMS [σ]', 'stated σ [m]', 'error [m]'], run.landmarks);
  document.querySelectorAll('#landmarks tbody tr').forEach((row, n) => {
    const cell = row.children[0], button = document.createElement('button');
    button.textContent = cell.textContent;
    button.addEventListener('click', () => showLife(run.landmarks[n][0]));
    cell.replaceChildren(button);
  });
  fillTable('figures', [], run.figures);
  fillTable('settings', ['name', 'value', 'default'], run.settings);
  fillTable('versions', [], run.versions);
  const warnings = run.warnings.length ? run.warnings : ['none'];
  warnings.forEach((/** @type {string} */ text) => { const item = document.createElement('li'); item.textContent = text; element('warnings').append(item); });
}

function draw() {
  if (!run.instants.t.length) { element('time-bar').hidden = true; saves.forEach((buttons) => { buttons.hidden = true; }); return; }
  drawMap('map', PLAN);
  element('views').hidden = element('side').hidden = element('save-side').hidden = run.is_flat;
  if (!run.is_flat) drawMap('side', chosenView());
  drawCurves();
  update();
}

/** @type {NodeListOf<HTMLElement>} */
const saves = document.querySelectorAll('.save');
saves.forEach((buttons) => buttons.querySelectorAll('button').forEach((button) => {
  button.addEventListener('click', () => save(buttons.id.replace('save-', ''), (button.textContent || '').toLowerCase()));
}));
write();
slider.max = String(Math.max(run.instants.t.length - 1, 0));
slider.value = slider.max;
draw();
const wanted = /^#t=([0-9.]+)$/.exec(location.hash);
if (wanted) goTo(Number(wanted[1]));
slider.addEventListener('input', show);
['turn', 'tilt'].forEach((id) => element(id).addEventListener('input', () => drawMap('side', chosenView())));
dark.addEventListener('change', draw);
addEventListener('beforeprint', () => { printing = true; draw(); });
addEventListener('afterprint', () => { printing = false; draw(); });
