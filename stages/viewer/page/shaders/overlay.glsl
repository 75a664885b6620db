// What is drawn over the picture: the picture itself (QUAD; with COPY into another); lines, points and the mesh (else), which the picture's surface
// hides where it lies in front of them by more than RELATIVE_MARGIN of the distance and MARGIN. Both are defined.
#ifdef VERTEX
#ifdef QUAD
out vec2 at;
void main() {
    at = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0;
    gl_Position = vec4(at * 2.0 - 1.0, 0.0, 1.0);
}
#else
uniform mat4 clipFromScene;
uniform vec4 ball; // middle and radius of the sphere in which positions are given
uniform float pointSize;
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 colour;
out vec3 tint;
out vec3 point;
void main() {
    point = ball.xyz + ball.w * position;
    gl_Position = clipFromScene * vec4(point, 1.0);
    gl_PointSize = pointSize;
    tint = colour;
}
#endif
#else
layout(location = 0) out vec4 shown;
#ifdef QUAD
uniform highp sampler2D picture;
in vec2 at;
#ifdef COPY
uniform highp usampler2D surfaces;
layout(location = 1) out uint surface;
#endif
void main() {
#ifdef COPY
    shown = texture(picture, at);
    surface = texelFetch(surfaces, ivec2(at * vec2(textureSize(surfaces, 0))), 0).r;
#else
    shown = vec4(texture(picture, at).rgb, 1.0);
#endif
}
#else
const int PLAIN = 0, COLOURED = 1, CLAY = 2; // shadings

uniform highp usampler2D surfaces; // of the picture: bits of distances
uniform vec2 size; // of the canvas, in pixels
uniform vec3 eye;
uniform bool hides; // whether that surface hides
uniform bool cropped;
uniform vec3 cropLow;
uniform vec3 cropHigh;
uniform int shading;
in vec3 tint;
in vec3 point;
void main() {
    vec3 away = point - eye;
    vec3 normal = normalize(cross(dFdx(point), dFdy(point)));
    if (cropped && (any(lessThan(point, cropLow)) || any(greaterThan(point, cropHigh)))) discard;
    if (hides) {
        ivec2 pixel = ivec2(gl_FragCoord.xy / size * vec2(textureSize(surfaces, 0)));
        float surface = uintBitsToFloat(texelFetch(surfaces, pixel, 0).r);
        if (length(away) > surface * (1.0 + RELATIVE_MARGIN) + MARGIN) discard;
    }
    float light = shading == PLAIN ? 1.0 : abs(dot(normal, normalize(away)));
    vec3 base = shading == CLAY ? vec3(0.78) : tint;
    shown = vec4(base * (shading == CLAY ? 0.3 + 0.7 * light : 0.75 + 0.25 * light), 1.0);
}
#endif
#endif
