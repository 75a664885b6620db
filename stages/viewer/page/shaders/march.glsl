// A pixel: its ray marched through the field from front to back, as HashGridField.render (nerf/fields/hash_grid.py) does
// it, then the colour effects (nerf/effects). Defined: MAX_STEPS, a bound on the steps of any ray.

const float EARLY_STOP_TRANSMITTANCE = 1e-3;
const float OPAQUE = 800.0;
const int COLOUR = 0, DEPTH = 1, NORMALS = 2, OPACITY = 3, COST = 4; // views
const uint INFINITE = 0x7f800000u; // bits of a float

uniform int view;
uniform vec2 size; // of the picture, in pixels
uniform vec4 lens; // focal lengths and principal point
uniform mat3 sceneFromCamera;
uniform vec3 centre;
uniform vec2 nearFar; // distances along the unit ray
uniform vec3 cropLow;
uniform vec3 cropHigh;
uniform bool cropped;
uniform float maxSamples;
uniform float opacityStep; // opacity that takes the colour of a neighbouring sample
uniform vec3 background;
uniform vec3 logGain; // of the exposure shown, natural logarithms in linear light
uniform vec4 falloff; // of a photo's vignetting: three coefficients, 1 / (4 sin²(θ/2)) of the corner
uniform vec2 inverseDepthRange; // that the view of depth shows
uniform highp sampler2D palette;
layout(location = 0) out vec4 shown;
layout(location = 1) out uint surface; // bits of the distance at which half of the light is stopped

bool isOccupied(ivec3 cell, out float emptyDistance) {
    ivec3 brick = cell >> 2;
    int number = (brick.x * BRICKS + brick.y) * BRICKS + brick.z;
    uvec4 word = texelFetch(occupancy, ivec2(number % TEXTURE_WIDTH, number / TEXTURE_WIDTH), 0);
    ivec3 within = cell & 3;
    int bit = 16 * within.x + 4 * within.y + within.z;
    emptyDistance = (word.x | word.y) == 0u ? max(1.0, float(word.z)) : 0.0;
    return (((bit < 32 ? word.x : word.y) >> uint(bit & 31)) & 1u) != 0u;
}

// nerf/effects/exposure.py: s(exp(g) s⁻¹(c)) with the transfer curve s of sRGB.
float exposedChannel(float c, float gain) {
    float light = exp(gain) * (c > 0.04045 ? pow((c + 0.055) / 1.055, 2.4) : c / 12.92);
    return light > 0.04045 / 12.92 ? 1.055 * pow(light, 1.0 / 2.4) - 0.055 : 12.92 * light;
}

// nerf/effects/vignetting.py: the log gain of a direction less its mean over an image.
float vignetting(vec3 direction) {
    if (falloff.w == 0.0) return 0.0;
    vec3 away = direction - sceneFromCamera[2];
    float u = min(dot(away, away) * falloff.w, 1.0);
    vec3 terms = vec3(u * (3.0 - u * (3.0 - u)), u * u * (3.0 - 2.0 * u), u * u * u);
    return -dot(falloff.xyz, terms);
}

vec3 exposed(vec3 colour, vec3 direction) {
    vec3 gain = logGain + vignetting(direction);
    if (gain == vec3(0.0)) return colour;
    return vec3(exposedChannel(colour.r, gain.r), exposedChannel(colour.g, gain.g), exposedChannel(colour.b, gain.b));
}

struct Seen {
    vec4 rendered; // sums of weights times colour and distance
    float accumulated; // the opacity that these weights add up to
    float depth; // optical
    float median; // the distance at which half of the light is stopped, far where it is not
    int samples; // densities evaluated
    int colours; // colours evaluated
};

Seen marched(Ray scene) {
    Seen seen = Seen(vec4(0.0), 0.0, 0.0, scene.far, 0, 0);
    Ray ray = mapped(scene);
#ifndef SPACE_CONTRACTION
    ray = clipToBox(ray, vec3(-HALF), vec3(HALF));
#endif
    setDirection(scene.direction);
    vec3 inverse = clamp(2.0 * HALF / ray.direction, -1e30, 1e30);
    float first = tToS(ray.near);
    float last = tToS(ray.far) - first;
    float k = 0.0;
    for (int i = 0; i < MAX_STEPS; ++i) {
        if (k >= last || float(seen.samples) >= maxSamples) break;
        float s = first + k + 0.5;
        float t = sToT(s);
        if (t >= ray.far) break;
        vec3 point = ray.origin + t * ray.direction;
        vec3 unit = unitOfMapped(point);
        ivec3 cell = clamp(ivec3(unit * float(CELLS)), 0, CELLS - 1);
        float empty;
        if (!isOccupied(cell, empty)) {
            // Rounded down by a thousandth of a step: a step too few is looked at again, one too many is lost.
            float span = empty > 0.0 ? emptySpan(cell, empty, unit, point, inverse) : 0.0;
            k += empty > 0.0 ? max(1.0, floor(min(tToS(t + span) - s - 0.001, 1e6)) + 1.0) : 1.0;
            continue;
        }
        densityNetwork(unit);
        float from = sToT(first + k);
        float dt = (min(sToT(first + k + 1.0), ray.far) - from) * sceneLength(t);
        float tau = min(densityOf(geometry[0].x) * dt, OPAQUE);
        float before = seen.depth;
        seen.depth += tau;
        if (before < 0.6931472 && seen.depth >= 0.6931472) seen.median = toScene(from) + dt * (0.6931472 - before) / tau;
        float opacity = 1.0 - exp(-seen.depth);
        // Opacity-quantised colour sampling (nerf/kernels/torch/colour_sampling.py).
        if (floor(opacity / opacityStep + 0.5) > floor((1.0 - exp(-before)) / opacityStep + 0.5)) {
            vec3 colour = colourNetwork();
            seen.rendered += (opacity - seen.accumulated) * vec4(colour, toScene(t));
            seen.accumulated = opacity;
            ++seen.colours;
        }
        ++seen.samples;
        k += 1.0;
        if (1.0 - opacity < EARLY_STOP_TRANSMITTANCE) break;
    }
    return seen;
}

// The direction in which the density falls fastest, by central differences over about two steps.
vec3 normalAt(vec3 point, float reach) {
    vec3 slope;
    for (int axis = 0; axis < 3; ++axis) {
        vec3 aside = vec3(axis == 0, axis == 1, axis == 2) * reach;
        densityNetwork(clamp(unitOfScene(point - aside), 0.0, 1.0));
        slope[axis] = geometry[0].x;
        densityNetwork(clamp(unitOfScene(point + aside), 0.0, 1.0));
        slope[axis] -= geometry[0].x;
    }
    return normalize(slope + 1e-12);
}

vec4 bytesOf(uint word) {
    return vec4((uvec4(word) >> uvec4(0u, 8u, 16u, 24u)) & 255u) / 255.0;
}

void main() {
    vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
    vec3 direction = sceneFromCamera * normalize(vec3((pixel - lens.zw) / lens.xy, 1.0));
    Ray ray = Ray(centre, direction, nearFar.x, nearFar.y);
    if (cropped) ray = clipToBox(ray, cropLow, cropHigh);
    Seen seen = marched(ray);
    float transmittance = exp(-seen.depth);
    float opacity = 1.0 - transmittance;
    if (seen.accumulated > 0.0) seen.rendered *= opacity / seen.accumulated;
    surface = seen.median < ray.far ? floatBitsToUint(seen.median) : INFINITE;
    if (view == COST) {
        shown = bytesOf(uint(seen.samples) | (uint(seen.colours) << 16));
        return;
    }
    if (view == DEPTH) {
        float inverse = 1.0 / max(seen.rendered.w + transmittance * ray.far, 1e-6);
        float level = (inverse - inverseDepthRange.x) / (inverseDepthRange.y - inverseDepthRange.x);
        shown = vec4(texelFetch(palette, ivec2(clamp(level, 0.0, 1.0) * 255.0 + 0.5, 0), 0).rgb, opacity);
        return;
    }
    if (view == OPACITY) {
        shown = vec4(vec3(opacity), opacity);
        return;
    }
    if (view == NORMALS) {
        vec3 normal = vec3(0.0);
        if (seen.median < ray.far) {
            vec3 point = ray.origin + seen.median * direction;
            normal = normalAt(point, 1.5 * stepAt(point, seen.median));
        }
        shown = vec4(mix(vec3(0.5), 0.5 + 0.5 * normal, opacity), opacity);
        return;
    }
    vec3 behind = background;
#ifdef BACKGROUND_LEVELS
    if (!cropped) behind = backgroundModel(direction);
#endif
    // Effects act on what is not the plain background.
    vec3 colour = seen.rendered.rgb + transmittance * behind;
    vec3 radiance = max(colour - transmittance * background, 0.0);
    shown = vec4(clamp(colour + exposed(radiance, direction) - radiance, 0.0, 1.0), opacity);
}
