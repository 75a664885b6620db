// Vectors are arrays of three. A pose is {rotation, centre}: the rotation scene_from_camera holds the camera's axes
// right, down and forward one after the other, as WebGL wants matrices; axes as of OpenCV.

const add = (a, b) => a.map((x, i) => x + b[i]);
const subtract = (a, b) => a.map((x, i) => x - b[i]);
const scaled = (a, factor) => a.map((x) => x * factor);
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const norm = (a) => Math.sqrt(dot(a, a));
const unit = (a) => scaled(a, 1 / norm(a));
const clamp = (x, low, high) => Math.min(high, Math.max(low, x));

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** A vector turned about a unit axis (Rodrigues). */
function turned(vector, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return add(add(scaled(vector, c), scaled(cross(axis, vector), s)), scaled(axis, dot(axis, vector) * (1 - c)));
}

const column = (rotation, i) => rotation.slice(3 * i, 3 * i + 3);
const right = (pose) => column(pose.rotation, 0);
const down = (pose) => column(pose.rotation, 1);
const forward = (pose) => column(pose.rotation, 2);

/** A direction of the camera's frame in the scene. */
function toScene(rotation, direction) {
  return [0, 1, 2].map((row) => [0, 1, 2].reduce((sum, i) => sum + rotation[3 * i + row] * direction[i], 0));
}

/** From the rows [R | centre] that Python writes. */
function poseOfRows(rows) {
  return {
    rotation: [0, 1, 2].flatMap((i) => rows.map((row) => row[i])),
    centre: rows.map((row) => row[3]),
  };
}

/** The camera turned about an axis of the scene through a point. */
function turnedPose(pose, axis, angle, point) {
  return {
    rotation: [0, 1, 2].flatMap((i) => turned(column(pose.rotation, i), axis, angle)),
    centre: add(point, turned(subtract(pose.centre, point), axis, angle)),
  };
}

/** Unit quaternion (w, x, y, z) of a rotation (Shepperd's choice of the largest component). */
function quaternion(r) {
  const trace = r[0] + r[4] + r[8];
  const sizes = [trace, r[0], r[4], r[8]];
  const largest = sizes.indexOf(Math.max(...sizes));
  if (largest === 0) return unit([1 + trace, r[5] - r[7], r[6] - r[2], r[1] - r[3]]);
  if (largest === 1) return unit([r[5] - r[7], 1 + r[0] - r[4] - r[8], r[3] + r[1], r[6] + r[2]]);
  if (largest === 2) return unit([r[6] - r[2], r[3] + r[1], 1 - r[0] + r[4] - r[8], r[7] + r[5]]);
  return unit([r[1] - r[3], r[6] + r[2], r[7] + r[5], 1 - r[0] - r[4] + r[8]]);
}

/** The inverse of quaternion. */
function rotationOf([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
    2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
    2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y),
  ];
}

/** Between two rotations, the shorter way (Shoemake 1985). */
function slerp(from, to, share) {
  let a = quaternion(from), b = quaternion(to), cosine = dot(a, b);
  if (cosine < 0) [b, cosine] = [scaled(b, -1), -cosine];
  const angle = Math.acos(Math.min(1, cosine));
  if (angle < 1e-6) return rotationOf(unit(add(scaled(a, 1 - share), scaled(b, share))));
  const weights = [Math.sin((1 - share) * angle), Math.sin(share * angle)];
  return rotationOf(unit(add(scaled(a, weights[0]), scaled(b, weights[1]))));
}

/** A pose between two. */
function between(a, b, share) {
  return {
    rotation: slerp(a.rotation, b.rotation, share),
    centre: add(scaled(a.centre, 1 - share), scaled(b.centre, share)),
  };
}

/** A lens {width, height, fx, fy, cx, cy} in a picture of another size: all that it shows is in there, in the middle. */
function fitted(lens, width, height) {
  const scale = Math.min(width / lens.width, height / lens.height);
  return {
    width, height, scale, fx: lens.fx * scale, fy: lens.fy * scale,
    cx: width / 2 + (lens.cx - lens.width / 2) * scale,
    cy: height / 2 + (lens.cy - lens.height / 2) * scale,
  };
}

const lensOf = ([width, height, fx, fy, cx, cy]) => ({ width, height, fx, fy, cx, cy });

/** The unit direction in the scene in which a pixel looks. */
function pixelDirection(pose, lens, x, y) {
  return toScene(pose.rotation, unit([(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1]));
}

/** Pixel (x, y) and depth of a point of the scene. */
function projected(pose, lens, point) {
  const away = subtract(point, pose.centre);
  const [x, y, z] = [right(pose), down(pose), forward(pose)].map((axis) => dot(axis, away));
  return { x: lens.cx + (lens.fx * x) / z, y: lens.cy + (lens.fy * y) / z, depth: z };
}

/** The projection of a lens and pose as WebGL takes it, columns one after the other. */
function clipFromScene(pose, lens, near) {
  const rows = [
    add(scaled(right(pose), (2 * lens.fx) / lens.width), scaled(forward(pose), (2 * lens.cx) / lens.width - 1)),
    add(scaled(down(pose), (-2 * lens.fy) / lens.height), scaled(forward(pose), 1 - (2 * lens.cy) / lens.height)),
    forward(pose),
    forward(pose),
  ].map((row) => [...row, -dot(row, pose.centre)]);
  rows[2][3] -= 2 * near; // z - 2 near over z: from -1 at near to 1 far away
  return [0, 1, 2, 3].flatMap((i) => rows.map((row) => row[i]));
}

const REGION_HALF_SIDE = 0.9, MIN_NEAR = 0.05 * REGION_HALF_SIDE, NEIGHBOURS = 3;

function distancesToRegion(point) {
  const size = point.map(Math.abs);
  return {
    entry: norm(size.map((x) => Math.max(x - REGION_HALF_SIDE, 0))),
    exit: norm(size.map((x) => x + REGION_HALF_SIDE)),
  };
}

/** [near, far] of a camera that took no photo: near_and_far_between_views of nerf/geometry/near_far.py. */
function nearFarBetween(pose, views, bounded) {
  const nearest = views
    .map((view) => ({ offset: subtract(pose.centre, view.pose.centre), view }))
    .map((each) => ({ ...each, distance: norm(each.offset) }))
    .sort((a, b) => a.distance - b.distance)
    .slice(0, NEIGHBOURS);
  const least = Math.min(MIN_NEAR, ...nearest.map(({ view }) => view.nearFar[0]));
  if (bounded) {
    const { entry, exit } = distancesToRegion(pose.centre);
    const beyond = nearest.map(({ view }) => view.nearFar[0] - distancesToRegion(view.pose.centre).entry);
    return [Math.max(entry + Math.min(...beyond), least), exit];
  }
  const near = nearest.map(({ view, offset }) => view.nearFar[0] - Math.max(0, dot(offset, forward(pose))));
  return [Math.max(Math.min(...near), least), Math.max(...nearest.map((each) => each.view.nearFar[1] + each.distance))];
}
