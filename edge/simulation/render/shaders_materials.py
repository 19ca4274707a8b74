"""GLSL of the surface kinds, grouped into programs.

A CPU rasteriser runs both sides of every branch, so one large program would pay for all materials at every pixel;
each group of alike materials has its own.
"""

from __future__ import annotations

from edge.simulation.render.shaders_common import COLOUR_PREAMBLE, FOLIAGE_COVER
from edge.simulation.scene import Material

REFLECTION = """
// what a glossy surface sees in a direction: sky, a dark skyline, the road
vec3 surroundings(vec3 d, float roughness) {
    float skyline = 0.10 + 0.10 * noise(vec2(atan(d.x, d.z) * 1.3, 0.17), 5.0, 0.01).r;
    float up = -d.y;
    vec3 road = mix(u_horizon, u_zenith, 0.4) * 0.16 + u_sun_rgb * u_sun_share * 0.09;
    vec3 town = mix(u_horizon, u_zenith, 0.3) * vec3(0.26, 0.27, 0.25);
    float soft = 0.03 + roughness;
    vec3 low = mix(road, town, smoothstep(-soft, soft, up));
    return mix(low, sky_gradient(d) + sun_glow(d) * 0.5, smoothstep(skyline - soft, skyline + soft, up));
}
float sun_highlight(vec3 n, vec3 view, float power) {
    vec3 h = normalize(u_sun - view);
    return pow(max(dot(n, h), 0.0), power);
}
float fresnel(vec3 n, vec3 view, float base) {
    float c = 1.0 - clamp(dot(n, -view), 0.0, 1.0);
    float c2 = c * c;
    return base + (1.0 - base) * c2 * c2 * c;
}
"""

PLAIN = (
    REFLECTION
    + """
void main() {
    Spot s = spot_here();
    vec2 uv = planar(v_model, v_facing) + seeded(v_seed);
    vec3 albedo = v_colour;
    float fine = noise(uv, 0.6, s.footprint).r - 0.5;
    float broad = noise(uv + 7.0, 3.1, s.footprint).g - 0.5;
    float grain = noise(uv, 1.3, s.footprint).b - 0.5;
    float gloss = 0.0, base = 0.03;
    if (v_material == 9) {            // bark: furrows along the trunk
        vec2 furrow = vec2(uv.x * 3.0, uv.y * 0.45);
        albedo *= 0.75 + 0.9 * (noise(furrow, 1.4, s.footprint * 2.0).a - 0.4) + 0.5 * broad;
    } else if (v_material == 12) {    // cloth: weave, folds
        albedo *= 1.0 + 0.35 * fine + 0.25 * (noise(uv * vec2(2.0, 0.7), 1.1, s.footprint).g - 0.5);
    } else if (v_material == 11) {    // skin
        albedo *= 1.0 + 0.12 * fine;
    } else if (v_material == 3) {     // rubber
        albedo *= 1.0 + 0.3 * grain + 0.4 * fine; gloss = 0.15;
    } else if (v_material == 13) {    // lamp: clear cover over a bright bowl
        albedo *= 1.0 + 0.3 * grain; gloss = 1.0; base = 0.08;
    } else if (v_material == 15) {    // sign
        albedo *= 1.0 + 0.08 * broad; gloss = 0.3;
    } else {
        albedo *= 1.0 + 0.30 * fine + 0.35 * broad + 0.2 * grain;
    }
    vec3 radiance = max(albedo, 0.0) * diffuse_light(v_world, s.n, 1.0);
    radiance += surroundings(reflect(s.view, s.n), 0.2) * (gloss * fresnel(s.n, s.view, base));
    finish(radiance, s);
}
"""
)

GLOSSY = (
    REFLECTION
    + """
void main() {
    Spot s = spot_here();
    vec2 uv = planar(v_model, v_facing) + seeded(v_seed);
    float dirt = noise(uv, 1.7, s.footprint).r;
    float broad = noise(uv + 3.0, 4.3, s.footprint).g - 0.5;
    vec3 away = reflect(s.view, s.n);
    float lit = sun_visibility(v_world, s.n) * u_sun_share * step(0.0, dot(s.n, u_sun));
    float open = sky_visibility(v_world, s.n);
    vec3 diffuse = u_sun_rgb * (lit * max(dot(s.n, u_sun), 0.0)) + sky_light(s.n) * open;
    vec3 radiance;
    if (v_material == 2) {            // glass over a dark cabin
        float f = fresnel(s.n, s.view, 0.06);
        vec3 cabin = vec3(0.028, 0.030, 0.032) * (0.5 + dirt + broad);
        radiance = (v_colour * 0.35 + cabin) * diffuse * 0.55 + surroundings(away, 0.02) * f * 1.25;
        radiance += u_sun_rgb * (lit * 6.0 * sun_highlight(s.n, s.view, 900.0));
    } else if (v_material == 4) {     // metal
        vec3 tone = v_colour * (0.85 + 0.3 * dirt + 0.3 * broad);
        radiance = tone * (diffuse * 0.35 + surroundings(away, 0.25) * 0.8);
        radiance += tone * u_sun_rgb * (lit * 2.0 * sun_highlight(s.n, s.view, 40.0));
    } else {                          // paint under clear coat, dusty low down
        float low = smoothstep(-0.75, -0.15, v_model.y);
        vec3 tone = v_colour * (0.94 + 0.10 * dirt + 0.08 * broad);
        tone = mix(tone, vec3(0.16, 0.145, 0.12), low * 0.45 * dirt);
        float f = fresnel(s.n, s.view, 0.05) * (1.0 - 0.5 * low * dirt);
        radiance = tone * diffuse + surroundings(away, 0.03) * f * (0.3 + 0.7 * open);
        radiance += u_sun_rgb * lit * (5.0 * sun_highlight(s.n, s.view, 700.0) + 0.25 * sun_highlight(s.n, s.view, 25.0) * tone);
    }
    finish(radiance, s);
}
"""
)

GROUND = """
void main() {
    Spot s = spot_here();
    vec2 uv = planar(v_model, v_facing) + seeded(v_seed);
    float fp = s.footprint;
    float grain = noise(uv, 1.9, fp).b - 0.5;
    float coarse = noise(uv.yx, 3.7, fp * 1.4).r - 0.5;
    float patches = noise(uv, 23.0, fp).g;
    float large = noise(uv.yx + 11.0, 87.0, fp).r - 0.5;
    float crack_at = noise(uv, 31.0, fp).a;
    float crack = (1.0 - smoothstep(0.02, 0.045 + fp * 0.2, crack_at)) * smoothstep(0.45, 0.75, patches);
    vec3 asphalt_tone = vec3(0.125, 0.124, 0.120);
    float texture_gain = 1.0 + 0.75 * grain + 0.45 * coarse + 0.35 * (patches - 0.5) + 0.35 * large;
    vec3 albedo = v_colour;
    if (v_material == 6) {            // marking: worn paint lets the road through
        float worn = noise(uv, 2.9, fp).r * 0.55 + noise(uv, 0.9, fp).b * 0.45;
        float kept = smoothstep(0.22, 0.42, worn + 0.25 * large);
        albedo = mix(asphalt_tone * texture_gain, v_colour * (1.0 + 0.18 * grain + 0.15 * coarse), 0.15 + 0.85 * kept);
    } else if (v_material == 14) {    // concrete: paler grain, slab joints, stains
        vec2 slab = abs(fract(uv / vec2(0.6)) - 0.5) * 0.6;
        float joint = 1.0 - smoothstep(0.285 - fp * 0.6, 0.297, max(slab.x, slab.y));
        float fade = clamp(1.0 - fp * 9.0, 0.0, 1.0);
        albedo *= (1.0 + 0.35 * grain + 0.3 * coarse + 0.4 * (patches - 0.5)) * mix(1.0, 0.72 + 0.28 * joint, fade);
    } else {                          // asphalt: aggregate, mended patches, cracks
        float mended = smoothstep(0.80, 0.815 + fp, noise(uv + 5.0, 41.0, fp).r);
        albedo *= texture_gain * (1.0 - 0.30 * mended) * (1.0 - 0.55 * crack);
    }
    vec3 radiance = max(albedo, vec3(0.004)) * diffuse_light(v_world, s.n, 1.0);
    float grazing = pow(1.0 - clamp(dot(s.n, -s.view), 0.0, 1.0), 5.0);
    vec3 away = reflect(s.view, s.n);
    radiance += (sky_gradient(away) * 0.12 + sun_glow(away) * 0.5 * u_sun_share) * grazing;
    finish(radiance, s);
}
"""

GRASS = """
void main() {
    Spot s = spot_here();
    vec2 uv = planar(v_model, v_facing) + seeded(v_seed);
    float fp = s.footprint;
    float blades = noise(uv, 1.1, fp).a - 0.45;
    float grain = noise(uv.yx, 0.7, fp).b - 0.5;
    float tufts = noise(uv, 3.9, fp).r - 0.5;
    float dry = noise(uv + 9.0, 27.0, fp).g;
    float large = noise(uv.yx, 71.0, fp).r - 0.5;
    vec3 albedo = mix(v_colour, v_colour * vec3(1.7, 1.25, 0.9), smoothstep(0.55, 0.95, dry));
    albedo *= max(1.0 + 0.7 * blades + 0.6 * grain + 0.8 * tufts + 0.5 * large, 0.12);
    vec3 n = normalize(s.n + vec3(grain, 0.0, blades) * 0.8);
    finish(albedo * diffuse_light(v_world, n, clamp(0.75 + 0.8 * tufts, 0.3, 1.0)), s);
}
"""

FOLIAGE = (
    FOLIAGE_COVER
    + """
void main() {
    Spot s = spot_here();
    float cover = leaf_cover(v_model, v_seed, s.footprint);
    int samples = int(cover * 4.0 + 0.5);
    if (samples == 0) discard;
    gl_SampleMask[0] = samples >= 4 ? 15 : samples == 3 ? 7 : samples == 2 ? 9 : 1;
    vec2 shift = seeded(v_seed);
    vec2 p = v_model.xy + v_model.zz * 0.5 + shift;
    vec2 q = v_model.zy - v_model.xx * 0.4 - shift;
    float leaf = noise(p, 1.3, s.footprint).a - 0.45;
    float grain = noise(q, 0.9, s.footprint).b - 0.5;
    float clump = noise(q, 3.3, s.footprint).r - 0.5;
    float broad = noise(p, 9.0, s.footprint).g - 0.5;
    vec3 n = normalize(s.n + vec3(grain, clump, leaf) * 1.3);
    vec3 albedo = v_colour * max(1.0 + 0.7 * leaf + 0.9 * grain + 0.9 * clump, 0.08);
    albedo *= vec3(1.0 + 0.5 * broad, 1.0 + 0.25 * broad, 1.0 - 0.2 * broad);
    vec3 light = diffuse_light(v_world, n, clamp(0.65 + 1.3 * clump, 0.2, 1.0));
    float through = max(dot(s.view, u_sun), 0.0);
    light += u_sun_rgb * u_sun_share * vec3(0.25, 0.32, 0.08) * through * (0.3 + leaf);
    finish(albedo * light, s);
}
"""
)

FACADE = (
    REFLECTION
    + """
void main() {
    Spot s = spot_here();
    vec2 uv = planar(v_model, v_facing);
    vec2 shift = seeded(v_seed);
    float fp = s.footprint / max(abs(dot(s.n, s.view)), 0.25);
    float grain = noise(uv + shift, 2.1, s.footprint).b - 0.5;
    float stain = noise(vec2(uv.x, uv.y * 0.35) + shift, 9.0, fp).r - 0.5;
    float broad = noise(uv + shift, 19.0, fp).g - 0.5;
    vec3 albedo = v_colour * (1.0 + 0.25 * grain + 0.30 * stain + 0.2 * broad);
    vec3 gloss = vec3(0.0);
    if (abs(v_facing.y) < 0.5) {
        float h1 = hash1(v_seed + 1.0), h2 = hash1(v_seed + 2.0), h3 = hash1(v_seed + 3.0);
        // bricks for some, rendered wall for others
        if (h1 < 0.45) {
            vec2 b = vec2(uv.x / 0.25, uv.y / 0.085);
            b.x += 0.5 * floor(mod(b.y, 2.0));
            vec2 in_brick = abs(fract(b) - 0.5);
            float mortar = smoothstep(0.40, 0.46, in_brick.y) + smoothstep(0.44, 0.48, in_brick.x);
            float keep = clamp(1.0 - fp * 14.0, 0.0, 1.0);
            albedo *= 1.0 + keep * (0.5 * (hash2(floor(b)) - 0.5) + 0.35 * min(mortar, 1.0));
        }
        float storey = 2.8 + 0.7 * h2, bay = 1.9 + 1.9 * h3;
        float height = -uv.y;
        vec2 cell = vec2(uv.x / bay + 0.5, height / storey);
        vec2 id = floor(cell);
        vec2 at = fract(cell);
        vec2 half_size = vec2(mix(0.20, 0.34, hash1(v_seed + 4.0)), mix(0.22, 0.33, h3));
        vec2 centre = vec2(0.5, 0.55);
        vec2 blur = vec2(fp / bay, fp / storey) * 0.7 + 0.002;
        vec2 off = abs(at - centre) - half_size;
        vec2 pane2 = 1.0 - smoothstep(-blur, blur, off);
        float frame_w = 0.07;
        vec2 frame2 = 1.0 - smoothstep(-blur, blur, off - vec2(frame_w / bay, frame_w / storey));
        float cross_bar = 1.0 - smoothstep(0.035 / bay - blur.x * 0.5, 0.035 / bay + blur.x, abs(at.x - 0.5));
        float exists = step(0.06, hash2(id + v_seed)) * step(0.0, height);
        float pane = pane2.x * pane2.y * exists * (1.0 - cross_bar);
        float frame = frame2.x * frame2.y * exists;
        float lit_room = hash2(id * 1.7 + v_seed + 5.0);
        vec3 trim = mix(vec3(0.75), albedo * 0.45, step(0.6, hash1(v_seed + 6.0)));
        albedo = mix(albedo, trim, frame * 0.9);
        float curtain = smoothstep(0.45, 0.55, lit_room) * smoothstep(0.15, 0.45, abs(at.x - 0.5) / half_size.x * 0.5 + 0.2 * lit_room);
        vec3 inside = mix(vec3(0.02, 0.022, 0.025), vec3(0.30, 0.28, 0.25), curtain * 0.8);
        albedo = mix(albedo, inside, pane);
        float ledge = smoothstep(0.035, 0.0, abs(at.y - 0.03)) * step(0.5, h1);
        albedo *= 1.0 + 0.25 * ledge;
        float sill = smoothstep(0.02, 0.0, abs(off.y + 0.0)) * frame2.x * step(at.y, centre.y) * exists;
        albedo *= 1.0 - 0.3 * sill;
        vec3 n = normalize(s.n + 0.03 * vec3(hash2(id) - 0.5, hash2(id + 3.0) - 0.5, hash2(id + 7.0) - 0.5));
        gloss = surroundings(reflect(s.view, n), 0.02) * (pane * fresnel(n, s.view, 0.09));
    } else {                          // roof: rows of tiles
        float rows_of_tiles = abs(fract(v_model.x / 0.32 + v_model.z / 0.32) - 0.5);
        float keep = clamp(1.0 - s.footprint * 5.0, 0.0, 1.0);
        albedo *= 1.0 + keep * 0.8 * (rows_of_tiles - 0.25);
    }
    vec3 radiance = max(albedo, 0.0) * diffuse_light(v_world, s.n, 1.0) + gloss;
    finish(radiance, s);
}
"""
)

MATERIAL_PROGRAMS: dict[str, tuple[frozenset[Material], str]] = {
    "plain": (
        frozenset(
            {
                Material.MATTE,
                Material.RUBBER,
                Material.BARK,
                Material.SKIN,
                Material.CLOTH,
                Material.LAMP,
                Material.SIGN,
            }
        ),
        COLOUR_PREAMBLE + PLAIN,
    ),
    "glossy": (frozenset({Material.CAR_PAINT, Material.GLASS, Material.METAL}), COLOUR_PREAMBLE + GLOSSY),
    "ground": (frozenset({Material.ASPHALT, Material.MARKING, Material.CONCRETE}), COLOUR_PREAMBLE + GROUND),
    "grass": (frozenset({Material.GRASS}), COLOUR_PREAMBLE + GRASS),
    "facade": (frozenset({Material.FACADE}), COLOUR_PREAMBLE + FACADE),
    "foliage": (frozenset({Material.FOLIAGE}), COLOUR_PREAMBLE + FOLIAGE),
}
"""Program name -> the materials it draws, its fragment stage. Foliage is last: it alone has holes."""
