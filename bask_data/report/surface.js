"use strict";
// A surface that can be turned: WebGL 2, no library. Each canvas carries its data; where WebGL is missing, the pictures
// below it stay. Nothing is drawn between the user's actions.
(() => {
  const VERTEX = `#version 300 es
    in vec3 position; in vec3 colour; uniform mat4 view; uniform vec3 low; uniform float scale;
    out vec3 tint; out vec3 place;
    void main() { place = low + scale * position; tint = colour; gl_Position = view * vec4(place, 1.0); }`;
  const FRAGMENT = `#version 300 es
    precision highp float; in vec3 tint; in vec3 place; uniform vec3 eye; uniform float lit; out vec4 shade;
    void main() {
      float facing = 1.0;
      if (lit > 0.5) facing = abs(dot(normalize(cross(dFdx(place), dFdy(place))), normalize(eye - place)));
      shade = vec4(tint * (0.4 + 0.6 * facing), 1.0);
    }`;
  const add = (a, b, f = 1) => a.map((x, i) => x + f * b[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((x) => x / n); };
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));

  function show(root) {
    const canvas = root.querySelector("canvas"), data = JSON.parse(canvas.dataset.surface);
    const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
    if (!gl) return;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "position"); gl.bindAttribLocation(program, 1, "colour");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return;
    root.classList.add("shown");
    const at = (name) => gl.getUniformLocation(program, name);
    const buffer = (values, target = gl.ARRAY_BUFFER) => {
      const made = gl.createBuffer(); gl.bindBuffer(target, made); gl.bufferData(target, values, gl.STATIC_DRAW); return made;
    };
    const attribute = (i, from, type, normalised) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, from); gl.enableVertexAttribArray(i); gl.vertexAttribPointer(i, 3, type, normalised, 0, 0);
    };
    const indices = new Uint16Array(bytes(data.triangles).buffer), points = new Float32Array(bytes(data.points).buffer);
    const vertices = buffer(new Uint16Array(bytes(data.vertices).buffer)), lines = buffer(points);
    const colours = { colours: buffer(bytes(data.colours)), objects: buffer(bytes(data.objects)) };
    const lineColours = buffer(bytes(data.pointColours)), elements = buffer(indices, gl.ELEMENT_ARRAY_BUFFER);

    // The camera circles around a target: turn and height are angles about the upwards axis.
    const up = unit(data.up), size = Math.hypot(...add(data.high, data.low, -1));
    const begin = add(data.eye, add(data.low, data.high).map((x) => x / 2), -1);
    const level = unit(add(begin, up, -dot(begin, up))), side = cross(up, level);
    const home = { turn: 0, height: Math.asin(Math.max(-1, Math.min(1, dot(unit(begin), up)))), distance: Math.hypot(...begin) };
    let target, look, by = "colours";
    const reset = () => { target = add(data.low, data.high).map((x) => x / 2); look = { ...home }; };
    const axes = () => {
      const flat = add(level.map((x) => x * Math.cos(look.turn)), side, Math.sin(look.turn));
      const back = add(flat.map((x) => x * Math.cos(look.height)), up, Math.sin(look.height));
      const right = unit(cross(up, back));
      return { back, right, above: cross(back, right) };
    };
    function draw() {
      const ratio = Math.min(window.devicePixelRatio || 1, 2), w = canvas.clientWidth, h = canvas.clientHeight;
      if (!w || !h) return;
      canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
      const { back, right, above } = axes(), eye = add(target, back, look.distance);
      const near = Math.max(look.distance / 50, 0.001), far = look.distance + 5 * size, f = 2.6, fx = f * Math.min(1, h / w);
      const fy = fx * w / h, a = (far + near) / (near - far), b = 2 * far * near / (near - far);
      const rows = [right.map((x) => fx * x), above.map((x) => fy * x), back.map((x) => a * x), back.map((x) => -x)];
      const last = [-fx * dot(right, eye), -fy * dot(above, eye), b - a * dot(back, eye), dot(back, eye)];
      const view = [0, 1, 2].flatMap((column) => rows.map((row) => row[column])).concat(last);
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(44 / 255, 48 / 255, 56 / 255, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST); gl.useProgram(program);
      gl.uniformMatrix4fv(at("view"), false, view); gl.uniform3fv(at("eye"), eye);
      // Rooms are recorded from the inside: from outside, the backs of their walls are left out.
      gl.enable(gl.CULL_FACE);
      gl.uniform3fv(at("low"), data.low); gl.uniform1f(at("scale"), data.scale); gl.uniform1f(at("lit"), 1);
      attribute(0, vertices, gl.UNSIGNED_SHORT, true); attribute(1, colours[by], gl.UNSIGNED_BYTE, true);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, elements); gl.drawElements(gl.TRIANGLES, indices.length, gl.UNSIGNED_SHORT, 0);
      gl.uniform3fv(at("low"), [0, 0, 0]); gl.uniform1f(at("scale"), 1); gl.uniform1f(at("lit"), 0);
      attribute(0, lines, gl.FLOAT, false); attribute(1, lineColours, gl.UNSIGNED_BYTE, true);
      gl.drawArrays(gl.LINES, 0, points.length / 3);
    }
    let waits = false;
    const redraw = () => { if (!waits) { waits = true; requestAnimationFrame(() => { waits = false; draw(); }); } };
    const zoom = (factor) => { look.distance = Math.max(size / 200, Math.min(20 * size, look.distance * factor)); redraw(); };
    const turn = (x, y) => { look.turn -= x; look.height = Math.max(-1.55, Math.min(1.55, look.height + y)); redraw(); };
    const move = (x, y) => {
      const { right, above } = axes(), step = look.distance / Math.max(canvas.clientWidth, 1);
      target = add(add(target, right, -x * step), above, y * step); redraw();
    };
    // Until it is clicked, wheel and touch scroll the page.
    const fingers = new Map();
    const span = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      const old = fingers.get(event.pointerId);
      if (!old) return;
      const x = event.clientX - old[0], y = event.clientY - old[1], before = fingers.size === 2 ? span() : 0;
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (fingers.size === 2) { zoom(before / Math.max(span(), 1)); move(x / 2, y / 2); }
      else if (event.shiftKey || event.buttons === 2) move(x, y); else turn(x / 150, y / 150);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas) return;
      event.preventDefault(); zoom(Math.exp(event.deltaY / 600));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (step) turn(...step); else if (event.key === "+") zoom(0.9); else if (event.key === "-") zoom(1.1); else return;
      event.preventDefault();
    });
    root.querySelector(".reset").addEventListener("click", () => { reset(); redraw(); });
    const paint = root.querySelector(".paint");
    paint.hidden = data.objects === data.colours;
    paint.addEventListener("click", () => {
      by = by === "colours" ? "objects" : "colours"; paint.setAttribute("aria-pressed", by === "objects"); redraw();
    });
    canvas.addEventListener("webglcontextlost", () => root.classList.remove("shown"));
    new ResizeObserver(redraw).observe(canvas);
    reset(); draw();
  }
  // Only when they come into view: browsers keep few contexts.
  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) { seen.unobserve(entry.target); show(entry.target); }
  }, { rootMargin: "300px" });
  for (const root of document.querySelectorAll(".surface")) seen.observe(root);
})();
