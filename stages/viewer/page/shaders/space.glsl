// Where rays run in the cube of the grids, and where samples stand on them: nerf/geometry/space_maps,
// nerf/kernels/torch/marching.py. One of SPACE_BOX, SPACE_CONTRACTION, SPACE_NDC is defined.

struct Ray {
    vec3 origin;
    vec3 direction; // of unit length
    float near;
    float far;
};

uniform float stepSize;
uniform float coneAngle;

// RayStepping: t(s) = d s while steps are even, d / c exp(c s - 1) beyond.
float sToT(float s) {
    if (coneAngle == 0.0) return stepSize * s;
    return min(stepSize * s, stepSize / coneAngle) * exp(max(coneAngle * s - 1.0, 0.0));
}

float tToS(float t) {
    if (coneAngle == 0.0) return t / stepSize;
    float until = stepSize / coneAngle;
    return min(t, until) / stepSize + log(max(t, until) / until) / coneAngle;
}

// The slab method; a ray that misses the box gets an empty interval.
Ray clipToBox(Ray ray, vec3 low, vec3 high) {
    vec3 direction = mix(ray.direction, vec3(1e-30), equal(ray.direction, vec3(0.0)));
    vec3 a = (low - ray.origin) / direction;
    vec3 b = (high - ray.origin) / direction;
    vec3 enter = min(a, b);
    vec3 leave = max(a, b);
    float near = max(ray.near, max(max(enter.x, enter.y), enter.z));
    float far = min(ray.far, min(min(leave.x, leave.y), leave.z));
    bool hit = near < far;
    return Ray(ray.origin, ray.direction, hit ? near : ray.far, hit ? far : ray.far);
}

#ifdef SPACE_CONTRACTION
vec3 contracted(vec3 point) {
    vec3 size = abs(point);
    float r = max(max(size.x, size.y), max(size.z, 1.0));
    return (2.0 - 1.0 / r) * (point / r);
}
#endif

#ifdef SPACE_NDC
const float MIN_REST = 1e-6;
const float MIN_DEPTH = 1e-3;
uniform vec3 apex;
uniform mat3 axesFromScene; // rows: right, down, forward of the virtual camera
uniform vec2 slopes;
uniform float nearPlane;

struct Line {
    float start;
    float depth;
    float slope;
    float speed;
};
Line line; // of this fragment's ray

vec3 projected(vec2 sideways, float depth) {
    return vec3(sideways * (HALF / slopes) / depth, HALF * (1.0 - 2.0 * nearPlane / depth));
}
#endif

// The ray as a straight line in the cube, or in the scene where space is contracted at each sample.
Ray mapped(Ray ray) {
#ifdef SPACE_NDC
    vec3 origin = axesFromScene * (ray.origin - apex);
    vec3 direction = axesFromScene * ray.direction;
    float slope = direction.z;
    float passes = (nearPlane - origin.z) / (slope == 0.0 ? 1e-30 : slope);
    float start = slope > 0.0 ? max(ray.near, passes) : ray.near;
    float far = slope < 0.0 ? min(ray.far, passes) : ray.far;
    vec3 atStart = origin + start * direction;
    float depth = start > ray.near ? max(atStart.z, nearPlane) : atStart.z;
    bool seen = start < far && depth >= nearPlane;
    depth = max(depth, nearPlane);
    vec3 at = projected(atStart.xy, depth);
    vec3 velocity = vec3(direction.xy * (HALF / slopes) - at.xy * slope, (HALF - at.z) * slope);
    float speed = length(velocity);
    line = Line(seen ? start : ray.far, depth, slope, speed);
    float beyond = max(far - start, 0.0);
    float reach = speed * beyond / max(depth + slope * beyond, MIN_REST * depth);
    return Ray(at, velocity / speed, 0.0, seen ? reach : 0.0);
#else
    return ray;
#endif
}

// Distance in the scene of one along the mapped ray.
float toScene(float t) {
#ifdef SPACE_NDC
    float share = t / line.speed;
    return line.start + share * line.depth / max(1.0 - share * line.slope, MIN_REST);
#else
    return t;
#endif
}

// Length in the scene for a length along the mapped ray: the derivative of toScene.
float sceneLength(float t) {
#ifdef SPACE_NDC
    float rest = max(1.0 - t / line.speed * line.slope, MIN_REST);
    return line.depth / (line.speed * rest * rest);
#else
    return 1.0;
#endif
}

// Unit coordinates, [0, 1]³, of a point of the mapped ray.
vec3 unitOfMapped(vec3 point) {
#ifdef SPACE_CONTRACTION
    point = contracted(point);
#endif
    return (point + HALF) / (2.0 * HALF);
}

// Unit coordinates of a point of the scene.
vec3 unitOfScene(vec3 point) {
#ifdef SPACE_NDC
    vec3 local = axesFromScene * (point - apex);
    return (projected(local.xy, max(local.z, MIN_DEPTH * nearPlane)) + HALF) / (2.0 * HALF);
#else
    return unitOfMapped(point);
#endif
}

// How far along the mapped ray it stays within the cube of 2 empty - 1 bricks per side around a cell: nothing there is
// occupied. As _empty_span of nerf/kernels/warp/marching.py, which derives the bound for contracted space.
float emptySpan(ivec3 cell, float empty, vec3 unit, vec3 point, vec3 inverse) {
    float width = 1.0 / float(CELLS);
    float around = 4.0 * (empty - 1.0);
    vec3 low = (vec3(cell & ivec3(~3)) - around) * width;
    vec3 high = low + (2.0 * around + 4.0) * width;
    float bent = 0.0;
#ifdef SPACE_CONTRACTION
    vec3 size = abs(point);
    float r = max(max(size.x, size.y), size.z);
    vec3 face = min(unit - low, high - unit);
    float margin = 2.0 * HALF * min(min(face.x, face.y), face.z);
    bent = max(0.75 * margin, margin * r / (4.0 + margin));
    if (r >= 1.0) return bent;
    low = max(low, vec3(0.25)); // [-1, 1] of [-2, 2], where coordinates are linear
    high = min(high, vec3(0.75));
#endif
    vec3 exits = max((low - unit) * inverse, (high - unit) * inverse);
    return max(bent, min(min(exits.x, exits.y), exits.z));
}

// Length in the scene of a step at a point of the scene, t away from the camera.
float stepAt(vec3 point, float t) {
#if defined(SPACE_CONTRACTION)
    return max(stepSize, coneAngle * t);
#elif defined(SPACE_NDC)
    vec3 local = axesFromScene * (point - apex);
    return stepSize * local.z * length(local) / (2.0 * HALF * nearPlane);
#else
    return stepSize;
#endif
}
