//! Procedural materials: colour as a function of the place on a surface.
//!
//! All colours are linear RGB; palette entries are written as sRGB hex.

use super::painting;
use glam::{IVec3, Vec2, Vec3};

/// A pattern with its colours.
#[derive(Debug, Clone, Copy)]
pub(super) struct Material {
    pub pattern: Pattern,
    /// Main colour.
    pub color: Vec3,
    /// Second colour of the pattern.
    pub accent: Vec3,
    /// Strength of the highlight, 0 for matte.
    pub gloss: f32,
    /// Distinguishes objects of the same material.
    pub seed: u32,
}

/// What a surface looks like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Pattern {
    /// One colour with a trace of unevenness.
    Plain,
    /// Floor boards along u.
    Planks,
    /// Wood grain along the longest side.
    Wood,
    Bricks,
    Wallpaper,
    Plaster,
    Rug,
    /// Woven cloth.
    Fabric,
    /// Cloth with stripes along v, that many per metre.
    Stripes(f32),
    /// Cloth with zigzag lines.
    Chevron,
    Dots,
    Marble,
    Checker(f32),
    /// Six segments around the z axis.
    Ball,
    /// Land and sea.
    Globe,
    Leaves,
    /// Spine of a book: bands along the height.
    Book,
    /// Boards in a frame.
    Crate,
    /// A painting, by number.
    Painting(u32),
    /// A view of the outside: emits light.
    Window,
    /// Emits `color`.
    Lamp,
}

/// Where a pattern is evaluated.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    /// Position on the face, metres from its lower left corner.
    pub uv_m: Vec2,
    /// Size of the face, metres.
    pub size_m: Vec2,
    /// Position in the object's frame, metres.
    pub local: Vec3,
}

impl Material {
    /// Matte material of two colours.
    pub fn new(pattern: Pattern, color: u32, accent: u32) -> Self {
        Self { pattern, color: hex(color), accent: hex(accent), gloss: 0.0, seed: 0 }
    }

    pub fn seeded(self, seed: u32) -> Self {
        Self { seed, ..self }
    }

    pub fn glossy(self, gloss: f32) -> Self {
        Self { gloss, ..self }
    }

    pub fn is_emissive(&self) -> bool {
        matches!(self.pattern, Pattern::Window | Pattern::Lamp)
    }

    /// Albedo, or emitted radiance of an emissive material.
    pub fn color_at(&self, place: &Place) -> Vec3 {
        let Place { uv_m, size_m, local } = *place;
        match self.pattern {
            Pattern::Plain => self.color * (0.96 + 0.08 * self.noise(local * 9.0)),
            Pattern::Planks => self.planks(uv_m),
            Pattern::Wood => self.wood(local, size_m, uv_m),
            Pattern::Bricks => self.bricks(uv_m),
            Pattern::Wallpaper => self.wallpaper(uv_m),
            Pattern::Plaster => self.color * (0.9 + 0.1 * self.fbm(local * 1.7, 4) + 0.05 * self.noise(local * 40.0)),
            Pattern::Rug => self.rug(uv_m, size_m),
            Pattern::Fabric => self.cloth(self.color, uv_m, local),
            Pattern::Stripes(per_m) => {
                let s = smooth_square(uv_m.x * per_m);
                self.cloth(self.color.lerp(self.accent, s), uv_m, local)
            }
            Pattern::Chevron => {
                let zigzag = uv_m.y * 9.0 + 0.8 * triangle(uv_m.x * 6.0);
                self.cloth(self.color.lerp(self.accent, smooth_square(zigzag)), uv_m, local)
            }
            Pattern::Dots => {
                let cell = (uv_m * 11.0).fract_gl() - 0.5;
                self.cloth(self.color.lerp(self.accent, step_down(cell.length(), 0.27, 0.05)), uv_m, local)
            }
            Pattern::Marble => {
                let p = local * 7.0;
                let vein = (2.2 * p.x + 1.5 * p.y + p.z + 6.0 * self.fbm(p, 4)).sin().abs();
                self.color.lerp(self.accent, (1.0 - vein).powi(3) * 0.95) * (0.9 + 0.15 * self.fbm(p * 2.0, 3))
            }
            Pattern::Checker(per_m) => {
                let q = (local * per_m + 0.01).floor();
                if (q.x + q.y + q.z).rem_euclid(2.0) < 1.0 { self.color } else { self.accent }
            }
            Pattern::Ball => self.ball(local),
            Pattern::Globe => self.globe(local),
            Pattern::Leaves => {
                let tone = self.fbm(local * 16.0, 3);
                let spots = self.noise(local * 38.0);
                self.color.lerp(self.accent, ((tone - 0.3) * 2.2).clamp(0.0, 1.0)) * (0.45 + 0.85 * spots)
            }
            Pattern::Book => self.book(uv_m, size_m, local),
            Pattern::Crate => self.crate_side(local, uv_m, size_m),
            Pattern::Painting(number) => painting::color(number, uv_m / size_m, size_m.x / size_m.y),
            Pattern::Window => painting::landscape(uv_m / size_m) * 2.6,
            Pattern::Lamp => self.color,
        }
    }

    fn noise(&self, p: Vec3) -> f32 {
        noise(p, self.seed)
    }

    fn fbm(&self, p: Vec3, octaves: u32) -> f32 {
        fbm(p, octaves, self.seed)
    }

    fn cloth(&self, color: Vec3, uv: Vec2, local: Vec3) -> Vec3 {
        let weave = (uv.x * 260.0).sin() * (uv.y * 260.0).sin();
        color * (0.86 + 0.05 * weave + 0.22 * self.fbm(local * 14.0, 3))
    }

    fn planks(&self, uv: Vec2) -> Vec3 {
        const WIDTH: f32 = 0.16;
        const LENGTH: f32 = 1.5;
        let row = (uv.y / WIDTH).floor();
        let along = uv.x / LENGTH + 7.31 * random(row as i32, 3, 0, self.seed);
        let board = random(row as i32, along.floor() as i32, 1, self.seed);
        let grain = self.fbm(Vec3::new(uv.x * 2.5, uv.y * 45.0, board * 50.0), 3);
        let flow = self.noise(Vec3::new(uv.x * 0.9, uv.y * 9.0, board * 90.0));
        let across = uv.y / WIDTH - row;
        let gap = step_down(across.min(1.0 - across) * WIDTH, 0.003, 0.003).max(step_down(
            (along - along.floor()).min(along.ceil() - along) * LENGTH,
            0.003,
            0.003,
        ));
        let tone = self.color.lerp(self.accent, (0.65 * board + 0.5 * grain + 0.3 * flow - 0.25).clamp(0.0, 1.0));
        tone * (0.75 + 0.45 * grain) * (1.0 - 0.75 * gap)
    }

    fn wood(&self, local: Vec3, size: Vec2, uv: Vec2) -> Vec3 {
        let along = if size.x >= size.y { Vec2::new(uv.x, uv.y) } else { Vec2::new(uv.y, uv.x) };
        let bend = self.noise(Vec3::new(along.x * 1.6, along.y * 4.0, local.z)) * 3.0;
        let rings = 0.5 + 0.5 * (along.y * 55.0 + bend * 4.0).sin();
        let grain = self.fbm(Vec3::new(along.x * 4.0, along.y * 70.0, 1.0), 3);
        self.color.lerp(self.accent, 0.45 * rings + 0.4 * grain) * (0.85 + 0.25 * grain)
    }

    fn bricks(&self, uv: Vec2) -> Vec3 {
        const SIZE: Vec2 = Vec2::new(0.25, 0.085);
        const JOINT: f32 = 0.012;
        let row = (uv.y / SIZE.y).floor();
        let x = uv.x / SIZE.x + 0.5 * (row.rem_euclid(2.0));
        let column = x.floor();
        let inside = Vec2::new(x - column, uv.y / SIZE.y - row) * SIZE;
        let edge = inside.min(SIZE - inside).min_element();
        let brick = random(column as i32, row as i32, 5, self.seed);
        let rough = self.fbm((uv * 26.0).extend(brick * 9.0), 3);
        let shade = 0.55 + 0.5 * brick + 0.45 * rough;
        let face = self.color.lerp(self.accent, random(column as i32, row as i32, 6, self.seed)) * shade;
        let mortar = Vec3::splat(0.5) * (0.7 + 0.5 * rough);
        face.lerp(mortar, step_down(edge, JOINT * 0.5, 0.004))
    }

    fn wallpaper(&self, uv: Vec2) -> Vec3 {
        const CELL: Vec2 = Vec2::new(0.36, 0.48);
        let stripe = 0.94 + 0.06 * smooth_square(uv.x / CELL.x);
        let column = (uv.x / CELL.x).floor();
        let q = Vec2::new(uv.x / CELL.x, uv.y / CELL.y + 0.5 * column.rem_euclid(2.0));
        let p = (q.fract_gl() - 0.5) * Vec2::new(1.0, CELL.y / CELL.x) * 2.0;
        let angle = p.y.atan2(p.x);
        let (r, petals) = (p.length(), (angle * 3.0).cos().abs());
        let flower = step_down(r, 0.18 + 0.2 * petals, 0.03) * (1.0 - step_down(r, 0.1, 0.02));
        let ring = step_down((r - 0.5 - 0.05 * (angle * 8.0).cos()).abs(), 0.022, 0.02);
        let stem = step_down((p.x - 0.12 * (p.y * 5.0).sin()).abs(), 0.02, 0.02) * step_down(-(r - 0.5), 0.0, 0.02);
        let ink = flower.max(ring).max(0.8 * stem);
        let paper = self.color * (stripe * (0.95 + 0.08 * self.noise((uv * 60.0).extend(0.0))));
        paper.lerp(self.accent, 0.75 * ink)
    }

    fn rug(&self, uv: Vec2, size: Vec2) -> Vec3 {
        let p = uv - 0.5 * size;
        let edge = uv.min(size - uv).min_element();
        let (red, blue, cream) = (self.color, self.accent, hex(0xe9dcc0));
        let thread = 0.82 + 0.3 * self.fbm((uv * Vec2::new(60.0, 130.0)).extend(0.0), 2);
        let color = if edge < 0.05 {
            cream.lerp(red, smooth_square((uv.x + uv.y) * 16.0))
        } else if edge < 0.09 {
            blue
        } else if edge < 0.24 {
            // Border of diamonds.
            let along = if uv.x.min(size.x - uv.x) < uv.y.min(size.y - uv.y) { uv.y } else { uv.x };
            let d = triangle(along * 7.0).abs() + ((edge - 0.165) / 0.075).abs();
            if d < 0.45 {
                cream
            } else if d < 0.8 {
                red * 1.2
            } else {
                blue.lerp(red, 0.2)
            }
        } else if edge < 0.28 {
            cream * 0.9
        } else {
            let d = (p.x / size.x).abs() + (p.y / size.y).abs();
            let medallion = (d * 22.0).floor();
            let small = (p * 9.0).fract_gl() - 0.5;
            let lattice = small.x.abs() + small.y.abs();
            if d < 0.27 {
                [cream, blue, red * 1.25, hex(0xc98a2b)][medallion.rem_euclid(4.0) as usize]
            } else if lattice < 0.13 {
                hex(0xd9a441)
            } else if lattice < 0.22 {
                blue
            } else {
                red
            }
        };
        color * thread
    }

    fn ball(&self, local: Vec3) -> Vec3 {
        let turn = (local.y.atan2(local.x) / std::f32::consts::TAU + 0.5) * 6.0;
        let segments = [self.color, hex(0xf4efe6), self.accent, hex(0xf4efe6), hex(0xe8b93a), hex(0xf4efe6)];
        let cap = local.z.abs() / local.length().max(1e-6);
        if cap > 0.95 { hex(0xf4efe6) } else { segments[(turn as usize).min(5)] }
    }

    fn globe(&self, local: Vec3) -> Vec3 {
        let n = local.normalize_or_zero();
        let land = self.fbm(n * 2.2 + 5.0, 5);
        let meridians = (n.y.atan2(n.x) * 12.0 / std::f32::consts::TAU).fract().abs();
        let line = step_down((meridians - 0.5).abs(), 0.02, 0.02).max(step_down(n.z.abs(), 0.012, 0.01));
        let ground = if n.z.abs() > 0.88 {
            hex(0xf2f4f5)
        } else if land > 0.53 {
            self.accent.lerp(hex(0xb89b5e), ((land - 0.53) * 9.0).clamp(0.0, 1.0))
        } else {
            self.color * (0.6 + land)
        };
        ground.lerp(hex(0xe8e0cc), 0.35 * line)
    }

    fn book(&self, uv: Vec2, size: Vec2, local: Vec3) -> Vec3 {
        let v = uv.y / size.y;
        let style = random(1, 2, 3, self.seed);
        let band = |at: f32, width: f32| (v - at).abs() < width;
        let is_band = band(0.12, 0.02)
            || band(0.88, 0.02)
            || (style > 0.5 && band(0.7, 0.08))
            || (style < 0.3 && band(0.5, 0.03));
        let base = if is_band { self.accent } else { self.color };
        base * (0.88 + 0.2 * self.fbm(local * 40.0, 2))
    }

    fn crate_side(&self, local: Vec3, uv: Vec2, size: Vec2) -> Vec3 {
        let edge = uv.min(size - uv).min_element();
        let diagonal = (uv.x / size.x - uv.y / size.y).abs() * size.x.min(size.y) * 0.7;
        let is_beam = edge < 0.06 || diagonal < 0.035;
        let gap =
            if is_beam { 0.0 } else { step_down((uv.y * 9.0).fract().min(1.0 - (uv.y * 9.0).fract()), 0.06, 0.04) };
        let rim = step_down((edge - 0.06).abs().min((diagonal - 0.035).abs()), 0.004, 0.004);
        let tone = if is_beam { self.accent } else { self.color };
        let wood = Self { color: tone, accent: tone * 0.6, ..*self }.wood(local, size, uv);
        wood * (1.0 - 0.7 * gap.max(0.7 * rim))
    }
}

/// Linear RGB of an sRGB colour `0xRRGGBB`.
pub(super) fn hex(rgb: u32) -> Vec3 {
    let channel = |shift: u32| {
        let c = ((rgb >> shift) & 0xff) as f32 / 255.0;
        // Cubic fit of the sRGB curve, 1e-3 close: palette colours need no more, and it is evaluated per sample.
        c * (c * (c * 0.305_306 + 0.682_171_1) + 0.012_522_88)
    };
    Vec3::new(channel(16), channel(8), channel(0))
}

/// 32 well-mixed bits of a lattice point.
fn lattice_hash(x: i32, y: i32, z: i32, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x8da6_b343)
        ^ (y as u32).wrapping_mul(0xd816_3841)
        ^ (z as u32).wrapping_mul(0xcb1a_b31f)
        ^ seed.wrapping_mul(0x9e37_79b9);
    h = (h ^ (h >> 16)).wrapping_mul(0x7feb_352d);
    h = (h ^ (h >> 15)).wrapping_mul(0x846c_a68b);
    h ^ (h >> 16)
}

/// Uniform in [0, 1), a function of the lattice point.
pub(super) fn random(x: i32, y: i32, z: i32, seed: u32) -> f32 {
    (lattice_hash(x, y, z, seed) >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Value noise in 0..1, feature size 1.
pub(super) fn noise(p: Vec3, seed: u32) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let s = f * f * (3.0 - 2.0 * f);
    let IVec3 { x, y, z } = cell.as_ivec3();
    let at = |dx: i32, dy: i32, dz: i32| random(x.wrapping_add(dx), y.wrapping_add(dy), z.wrapping_add(dz), seed);
    let mix = |a: f32, b: f32, t: f32| a + t * (b - a);
    let bottom = mix(mix(at(0, 0, 0), at(1, 0, 0), s.x), mix(at(0, 1, 0), at(1, 1, 0), s.x), s.y);
    let top = mix(mix(at(0, 0, 1), at(1, 0, 1), s.x), mix(at(0, 1, 1), at(1, 1, 1), s.x), s.y);
    mix(bottom, top, s.z)
}

/// Octaves of [`noise`], each half as strong and twice as fine; in 0..1.
pub(super) fn fbm(p: Vec3, octaves: u32, seed: u32) -> f32 {
    let (mut sum, mut weight, mut total, mut q) = (0.0, 0.5, 0.0, p);
    for octave in 0..octaves {
        sum += weight * noise(q, seed.wrapping_add(octave));
        total += weight;
        weight *= 0.5;
        q = q * 2.03 + 1.7;
    }
    sum / total
}

/// 1 below `edge`, 0 above `edge + width`, smooth between.
pub(super) fn step_down(x: f32, edge: f32, width: f32) -> f32 {
    let t = ((x - edge) / width).clamp(0.0, 1.0);
    1.0 - t * t * (3.0 - 2.0 * t)
}

/// Triangle wave of period 1 between −1 and 1.
pub(super) fn triangle(x: f32) -> f32 {
    4.0 * (x - (x + 0.5).floor()).abs() - 1.0
}

/// Square wave of period 1 between 0 and 1 with slightly soft edges.
pub(super) fn smooth_square(x: f32) -> f32 {
    (triangle(x) * 12.0 + 0.5).clamp(0.0, 1.0)
}
