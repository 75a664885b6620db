// A camera path through key-frames, and path.json as `pipeline render --render.cameras` reads it.

const FPS = 30;

class CameraPath {
  constructor() {
    this.keys = [];
  }

  /** Poses of all frames: Catmull-Rom splines through the centres, the shorter turn between rotations. */
  frames(secondsPerKey) {
    const { keys } = this, steps = Math.max(1, Math.round(secondsPerKey * FPS));
    if (keys.length < 2) return [...keys];
    const key = (i) => keys[clamp(i, 0, keys.length - 1)], poses = [];
    for (let i = 0; i + 1 < keys.length; ++i) {
      for (let step = 0; step < steps; ++step) {
        const t = step / steps, [a, b, c, d] = [i - 1, i, i + 1, i + 2].map((k) => key(k).centre);
        const centre = b.map((_, axis) => 0.5 * (2 * b[axis] + (c[axis] - a[axis]) * t
          + (2 * a[axis] - 5 * b[axis] + 4 * c[axis] - d[axis]) * t * t
          + (3 * b[axis] - a[axis] - 3 * c[axis] + d[axis]) * t * t * t));
        poses.push({ centre, rotation: slerp(key(i).rotation, key(i + 1).rotation, t) });
      }
    }
    return [...poses, keys[keys.length - 1]];
  }

  /** The content of path.json: poses in the sfm frame with OpenGL axes. */
  json(lens, sfmFromScene, secondsPerKey) {
    const frames = this.frames(secondsPerKey).map((pose, index) => ({
      file_path: String(index).padStart(5, "0"),
      transform_matrix: openglMatrix(pose, sfmFromScene),
    }));
    const { width, height, fx, fy, cx, cy } = lens;
    return { camera_model: "OPENCV", w: width, h: height, fl_x: fx, fl_y: fy, cx, cy, fps: FPS, frames };
  }
}

/** A pose of the scene frame as a matrix of the sfm frame, which is a similarity of it: y up, z backward. */
function openglMatrix(pose, sfmFromScene) {
  const rows = sfmFromScene.slice(0, 3), scale = norm(rows[0].slice(0, 3));
  const axes = [right(pose), scaled(down(pose), -1), scaled(forward(pose), -1)];
  const matrix = rows.map((row) => [
    ...axes.map((axis) => dot(row.slice(0, 3), axis) / scale),
    dot(row.slice(0, 3), pose.centre) + row[3],
  ]);
  return [...matrix, [0, 0, 0, 1]];
}
