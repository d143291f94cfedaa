// Draws a model of Gaussians in a page with WebGL 2, by the rules of obbgs_core.render: radiance is composited front to
// back in floating point, and what the sensor would read at the chosen exposure time is shown. Needs no network.
const ROW = 2048; // texels in a row of the data textures: the largest width that every WebGL 2 has
const FITTED = 1.0; // radii of the model that the shorter side of the picture shows at zoom 1
const DISTANCE = 8; // of the camera from the target's centre, radii; zooming narrows the field and never comes nearer
const ZOOM = [0.5, 16];
const HIGHEST = 1.55; // rad, elevation
const TURN_S = 24; // one turn of the model

const SHADE = `
  float soft(float x) { return x > 2.0 ? x : log(1.0 + exp(10.0 * x)) / 10.0; }
  float coefficient(int i, int k, int c) {
    int flat_ = 8 + k * channels + c;
    vec4 texel = fetch(params, i * perSplat + flat_ / 4);
    return texel[flat_ % 4];
  }
  void basis(vec3 d, out float b[16]) {
    float x = d.x, y = d.y, z = d.z;
    b[0] = 0.28209479177387814;
    b[1] = -0.4886025119029199 * y; b[2] = 0.4886025119029199 * z; b[3] = -0.4886025119029199 * x;
    b[4] = 1.0925484305920792 * x * y; b[5] = -1.0925484305920792 * y * z;
    b[6] = 0.31539156525252005 * (2.0 * z * z - x * x - y * y);
    b[7] = -1.0925484305920792 * x * z; b[8] = 0.5462742152960396 * (x * x - y * y);
    b[9] = -0.5900435899266435 * y * (3.0 * x * x - y * y); b[10] = 2.890611442640554 * x * y * z;
    b[11] = -0.4570457994644658 * y * (4.0 * z * z - x * x - y * y);
    b[12] = 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y);
    b[13] = -0.4570457994644658 * x * (4.0 * z * z - x * x - y * y);
    b[14] = 1.445305721320277 * z * (x * x - y * y); b[15] = -0.5900435899266435 * x * (x * x - 3.0 * y * y);
  }
  vec3 radianceOf(int i, vec3 direction, mat3 turned, vec3 scales) {
    float b[16];
    basis(shading > 0 ? sun : direction, b);
    vec3 sum = vec3(0.0);
    for (int k = 0; k < coefficients; k++)
      for (int c = 0; c < 3; c++) sum[c] += b[k] * coefficient(i, k, channels == 3 ? c : 0);
    vec3 radiance = vec3(soft(sum.x), soft(sum.y), soft(sum.z));
    float lit = 1.0;
    if (shading == 2) { // Lambert's law: the shortest axis on the camera's side is the normal
      vec3 normal = scales.x <= scales.y && scales.x <= scales.z ? turned[0]
        : scales.y <= scales.z ? turned[1] : turned[2];
      normal *= -sign(dot(normal, direction));
      float before = fetch(sunlit, sunBefore * count + i).r, after = fetch(sunlit, sunAfter * count + i).r;
      lit = mix(before, after, sunShare);
      radiance *= soft(dot(normal, sun)) * lit + ambient;
    }
    if (alpha > 0.0) { // a highlight: GGX around the lobe's axis
      vec4 lobe = fetch(params, (i + 1) * perSplat - 1);
      bool mirrors = shading != 0 || dot(staticSun, staticSun) > 0.0; // the axis is the normal of a mirror
      vec3 source = shading == 0 ? staticSun : sun;
      float cosine = dot(lobe.xyz, mirrors ? normalize(source - direction) : -direction);
      float cos2 = mirrors ? cosine * cosine : 0.5 + 0.5 * cosine;
      float root = alpha * alpha / max(1.0 - cos2 * (1.0 - alpha * alpha), 1e-9);
      radiance += lit * lobe.w * root * root * shine;
    }
    return radiance;
  }`;

const VERTEX = `#version 300 es
  precision highp float; precision highp int; precision highp sampler2D;
  uniform sampler2D means, params, sunlit;
  uniform mat3 rotation; uniform vec3 translation, sun, staticSun, eye, shine; uniform vec2 size;
  uniform float focal, widened, unit, ambient, sunShare, alpha; uniform bool lowers;
  uniform int perSplat, coefficients, channels, shading, count, sunBefore, sunAfter;
  in uint index;
  out vec2 offset; flat out vec3 conic; flat out vec3 light; flat out vec2 peak;
  vec4 fetch(sampler2D from, int i) { return texelFetch(from, ivec2(i % ${ROW}, i / ${ROW}), 0); }
  ${SHADE}
  void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside, unless all below holds
    int i = int(index);
    vec3 mean = fetch(means, i).xyz, p = rotation * mean + translation;
    vec4 q = normalize(fetch(params, i * perSplat)), shape = fetch(params, i * perSplat + 1);
    vec3 scales = exp(shape.xyz);
    float w = q.x, x = q.y, y = q.z, z = q.w;
    mat3 turned = mat3(
      1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
      2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
      2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
    if (p.z <= 0.01) return;
    vec2 limit = 1.3 * size / 2.0 / focal, ray = clamp(p.xy / p.z, -limit, limit);
    mat3 axes = rotation * mat3(turned[0] * scales.x, turned[1] * scales.y, turned[2] * scales.z);
    vec3 first = focal / p.z * (vec3(axes[0].x, axes[1].x, axes[2].x) - ray.x * vec3(axes[0].z, axes[1].z, axes[2].z));
    vec3 second = focal / p.z * (vec3(axes[0].y, axes[1].y, axes[2].y) - ray.y * vec3(axes[0].z, axes[1].z, axes[2].z));
    float xx = dot(first, first) + widened, xy = dot(first, second), yy = dot(second, second) + widened;
    float determinant = xx * yy - xy * xy, share = 1.0;
    vec3 area = cross(first, second);
    if (lowers) share = sqrt(dot(area, area) / determinant);
    float opacity = shape.w, reach = 2.0 * log(255.0 * opacity);
    if (!(determinant > 0.0) || share < ${1 / 4096} || !(reach > 0.0)) return;
    vec2 middle = focal * p.xy / p.z + size / 2.0;
    float mid = 0.5 * (xx + yy), apart = sqrt(max(mid * mid - determinant, 0.0));
    vec2 axis = abs(xy) > 1e-6 ? normalize(vec2(xy, mid + apart - xx)) : (xx >= yy ? vec2(1, 0) : vec2(0, 1));
    vec2 corner = 2.0 * vec2(gl_VertexID & 1, gl_VertexID >> 1) - 1.0;
    vec2 half_ = sqrt(reach * vec2(mid + apart, max(mid - apart, 1e-6)));
    offset = corner.x * half_.x * axis + corner.y * half_.y * vec2(-axis.y, axis.x);
    conic = vec3(yy, -xy, xx) / determinant;
    light = unit * radianceOf(i, normalize(mean - eye), turned, scales);
    peak = vec2(opacity * share, share / 255.0);
    vec2 at = 2.0 * (middle + offset) / size - 1.0;
    gl_Position = vec4(at.x, -at.y, 0.0, 1.0);
  }`;

const FRAGMENT = `#version 300 es
  precision highp float;
  in vec2 offset; flat in vec3 conic; flat in vec3 light; flat in vec2 peak; out vec4 colour;
  void main() {
    float power = -0.5 * (conic.x * offset.x * offset.x + conic.z * offset.y * offset.y) - conic.y * offset.x * offset.y;
    float alpha = min(0.99, peak.x * exp(min(power, 0.0)));
    if (alpha < peak.y) discard;
    colour = vec4(light * alpha, alpha);
  }`;

const CORNERS = `#version 300 es
  void main() { gl_Position = vec4(4.0 * vec2(gl_VertexID & 1, gl_VertexID >> 1) - 1.0, 0.0, 1.0); }`;
const EXPOSE = `#version 300 es
  precision highp float; uniform sampler2D drawn; uniform float background; uniform bool linear; out vec4 colour;
  void main() {
    vec4 sum = texelFetch(drawn, ivec2(gl_FragCoord.xy), 0);
    vec3 signal = clamp(sum.rgb + (1.0 - sum.a) * background, 0.0, 1.0); // of full scale, above black
    colour = vec4(linear ? sqrt(signal) : signal, 1.0);
  }`;

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const at = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const name = gl.getActiveUniform(made, i).name;
    at[name] = gl.getUniformLocation(made, name);
  }
  return { made, at };
}

function bytes(element) {
  return Uint8Array.from(atob(element.textContent), (c) => c.charCodeAt(0)).buffer;
}

function dataTexture(gl, inside, kind, format, type, values, perTexel) {
  const rows = Math.max(1, Math.ceil(values.length / perTexel / ROW));
  const padded = new values.constructor(rows * ROW * perTexel);
  padded.set(values);
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, inside, ROW, rows, 0, format, type, padded);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  return texture;
}

// Draws one model into a canvas; knows nothing of mouse or controls.
class Drawing {
  constructor(canvas, model, means, params, sunlit) {
    const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
    if (!gl || !gl.getExtension("EXT_color_buffer_float")) throw new Error("no WebGL 2 with floating-point pictures");
    Object.assign(this, { canvas, gl, model, means });
    this.splats = program(gl, VERTEX, FRAGMENT);
    this.expose = program(gl, CORNERS, EXPOSE);
    const half = [gl.RGBA16F, 0, gl.RGBA, gl.HALF_FLOAT, params, 4];
    this.textures = [
      dataTexture(gl, gl.RGB32F, 0, gl.RGB, gl.FLOAT, means, 3),
      dataTexture(gl, ...half),
      dataTexture(gl, gl.R8, 0, gl.RED, gl.UNSIGNED_BYTE, sunlit, 1),
    ];
    this.order = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * model.count, gl.DYNAMIC_DRAW);
    const at = gl.getAttribLocation(this.splats.made, "index");
    gl.enableVertexAttribArray(at);
    gl.vertexAttribIPointer(at, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(at, 1);
    this.sum = gl.createTexture();
    this.frame = gl.createFramebuffer();
    this.depths = new Float32Array(model.count);
    this.sorted = new Uint32Array(model.count);
    this.size = [0, 0];
  }

  resize() {
    const { gl, canvas } = this;
    if (this.size[0] === canvas.width && this.size[1] === canvas.height) return;
    this.size = [canvas.width, canvas.height];
    gl.bindTexture(gl.TEXTURE_2D, this.sum);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, canvas.width, canvas.height, 0, gl.RGBA, gl.HALF_FLOAT, null);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.sum, 0);
  }

  // Orders the Gaussians front to back by counting their depths in 65536 classes.
  sort(camera) {
    const { count } = this.model, { means, depths, sorted } = this, [a, b, c] = camera.rotation[2];
    let near = Infinity, far = -Infinity;
    for (let i = 0; i < count; i++) {
      const depth = a * means[3 * i] + b * means[3 * i + 1] + c * means[3 * i + 2];
      depths[i] = depth;
      if (depth < near) near = depth;
      if (depth > far) far = depth;
    }
    const starts = new Uint32Array(65537), factor = 65535 / Math.max(far - near, 1e-9);
    for (let i = 0; i < count; i++) starts[1 + ((depths[i] - near) * factor | 0)]++;
    for (let i = 1; i < 65537; i++) starts[i] += starts[i - 1];
    for (let i = 0; i < count; i++) sorted[starts[(depths[i] - near) * factor | 0]++] = i;
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.order);
    this.gl.bufferSubData(this.gl.ARRAY_BUFFER, 0, sorted);
  }

  draw(camera, exposureS, sun) {
    const { gl, canvas, model } = this, { sensor } = model;
    this.resize();
    this.sort(camera);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.splats.made);
    const { at } = this.splats;
    this.textures.forEach((texture, i) => { gl.activeTexture(gl.TEXTURE0 + i); gl.bindTexture(gl.TEXTURE_2D, texture); });
    gl.uniform1i(at.means, 0); gl.uniform1i(at.params, 1); gl.uniform1i(at.sunlit, 2);
    gl.uniformMatrix3fv(at.rotation, true, camera.rotation.flat());
    gl.uniform3fv(at.translation, camera.translation); gl.uniform3fv(at.eye, camera.eye);
    gl.uniform2f(at.size, canvas.width, canvas.height); gl.uniform1f(at.focal, camera.focalPx);
    gl.uniform1f(at.widened, model.footprint.constant_px2 + model.footprint.sensor_px2 * camera.scale ** 2);
    gl.uniform1i(at.lowers, model.footprint.lowers_peak);
    const unit = sensor.dn_per_radiance_s * exposureS / (sensor.white_dn - sensor.black_dn);
    gl.uniform1f(at.unit, unit); gl.uniform1f(at.ambient, model.ambient);
    gl.uniform1f(at.alpha, model.gloss ? model.gloss.alpha : 0); gl.uniform3fv(at.shine, model.gloss ? model.gloss.peak : [0, 0, 0]);
    gl.uniform3fv(at.staticSun, model.gloss?.sun ?? [0, 0, 0]);
    gl.uniform1i(at.perSplat, model.texels); gl.uniform1i(at.coefficients, model.coefficients);
    gl.uniform1i(at.channels, model.channels); gl.uniform1i(at.count, model.count);
    gl.uniform1i(at.shading, ["view", "sun", "lambert"].indexOf(model.shading));
    gl.uniform3fv(at.sun, sun.direction); gl.uniform1f(at.sunShare, sun.share);
    gl.uniform1i(at.sunBefore, sun.before); gl.uniform1i(at.sunAfter, sun.after);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE); // front to back
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, model.count);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.expose.made);
    gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_2D, this.sum);
    gl.uniform1i(this.expose.at.drawn, 0); gl.uniform1f(this.expose.at.background, unit * model.background);
    gl.uniform1i(this.expose.at.linear, model.encoding === "linear");
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
