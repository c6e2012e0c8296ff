//! The layout of the room: what stands where, in metres, z up, the floor at 0.

use super::geometry::Geometry;
use super::light::{RectLight, Sun};
use super::raycast::{Object, Shape};
use super::texture::{Material, Pattern, hex};
use crate::rng::Rng;
use glam::{Vec2, Vec3};

/// Half of the inner size of the room.
pub(super) const ROOM_HALF: Vec3 = Vec3::new(3.0, 2.5, 1.4);
/// Face of the room (the +y wall) with the window.
pub(super) const WINDOW_FACE: usize = 3;
/// Corners of the window on its wall, metres from the lower left corner of the wall: u along x, v along z.
pub(super) const WINDOW: (Vec2, Vec2) = (Vec2::new(1.8, 0.95), Vec2::new(4.0, 2.3));

/// Everything that [`super::SyntheticScene`] is made of.
pub(super) struct Layout {
    pub geometry: Geometry,
    pub materials: Vec<Material>,
    pub lights: Vec<RectLight>,
    pub sun: Sun,
}

/// Wall colours and rug of one variant of the room.
const SCHEMES: [[u32; 6]; 4] = [
    // bricks, wallpaper and its ink, plaster, rug and its second colour
    [0xb0603f, 0xdfe3d3, 0x6f8f7f, 0xe4dcc8, 0x9c2f2a, 0x22355c],
    [0xa8563c, 0xe8dcc6, 0xb07a4a, 0xd5dde0, 0x23505a, 0x8a3b2c],
    [0x9c5a48, 0xd7dfea, 0x4f6f9f, 0xeadfc4, 0x6d2a4a, 0x2d4a3f],
    [0xb86a48, 0xe9e0e0, 0xa0647a, 0xdfe4d4, 0x2c4870, 0xa33d2e],
];

/// The room of `seed`: the seed chooses colours and moves what can be moved.
pub(super) fn layout(seed: u64) -> Layout {
    let mut room = Builder { objects: Vec::new(), materials: Vec::new(), rng: Rng::with_stream(seed, 0x700) };
    let scheme = SCHEMES[(seed % SCHEMES.len() as u64) as usize];
    room.shell(scheme);
    room.window_wall();
    room.rug_and_table(scheme);
    room.sofa();
    room.bookshelf();
    room.sideboard();
    room.armchair();
    room.pictures();
    room.plant(Vec3::new(2.55, 2.05, 0.0));
    room.floor_lamp(Vec3::new(-2.55, -2.05, 0.0));
    room.things_on_the_floor();
    Layout {
        geometry: Geometry::new(room.objects),
        materials: room.materials,
        lights: lights(),
        sun: Sun { direction: Vec3::new(0.3, 1.0, 0.72).normalize(), irradiance: Vec3::new(9.0, 8.2, 6.8) },
    }
}

fn lights() -> Vec<RectLight> {
    let (low, high) = WINDOW;
    let middle = 0.5 * (low + high);
    let half = 0.5 * (high - low);
    let window = RectLight {
        center: Vec3::new(middle.x - ROOM_HALF.x, ROOM_HALF.y - 0.02, middle.y),
        half_u: Vec3::new(half.x, 0.0, 0.0),
        half_v: Vec3::new(0.0, 0.0, half.y),
        normal: Vec3::NEG_Y,
        radiance: Vec3::new(3.2, 3.5, 3.9),
        grid: (6, 4),
    };
    let panel = |center: Vec3, half: f32, normal: Vec3, radiance: Vec3, side: usize| RectLight {
        center,
        half_u: Vec3::new(half, 0.0, 0.0),
        half_v: Vec3::new(0.0, half, 0.0),
        normal,
        radiance,
        grid: (side, side),
    };
    vec![
        window,
        panel(Vec3::new(0.0, 0.0, 2.69), 0.26, Vec3::NEG_Z, Vec3::new(17.0, 15.6, 13.4), 4),
        panel(Vec3::new(-2.55, -2.05, 1.43), 0.12, Vec3::NEG_Z, Vec3::new(16.0, 11.0, 6.0), 3),
        panel(Vec3::new(-2.55, -2.05, 1.79), 0.10, Vec3::Z, Vec3::new(16.0, 11.0, 6.0), 3),
    ]
}

struct Builder {
    objects: Vec<Object>,
    materials: Vec<Material>,
    rng: Rng,
}

impl Builder {
    fn add(&mut self, shape: Shape, center: Vec3, yaw_deg: f32, material: Material) {
        self.materials.push(material.seeded(material.seed + self.materials.len() as u32));
        let index = (self.materials.len() - 1) as u16;
        let yaw = Vec2::from_angle(yaw_deg.to_radians());
        self.objects.push(Object { shape, center, yaw, materials: [index; 6] });
    }

    /// Cuboid of `size` that stands on the height of `base`.
    fn cuboid(&mut self, base: Vec3, size: Vec3, yaw_deg: f32, material: Material) {
        self.add(Shape::Cuboid { half: 0.5 * size }, base + Vec3::new(0.0, 0.0, 0.5 * size.z), yaw_deg, material);
    }

    fn sphere(&mut self, center: Vec3, radius: f32, yaw_deg: f32, material: Material) {
        self.add(Shape::Sphere { radius }, center, yaw_deg, material);
    }

    /// Frustum that stands on the height of `base`.
    fn frustum(&mut self, base: Vec3, bottom: f32, top: f32, height: f32, material: Material) {
        let half_height = 0.5 * height;
        self.add(Shape::Frustum { bottom, top, half_height }, base + half_height * Vec3::Z, 0.0, material);
    }

    fn shell(&mut self, [bricks, paper, ink, plaster, ..]: [u32; 6]) {
        let first = self.materials.len() as u16;
        self.materials.extend([
            Material::new(Pattern::Bricks, bricks, 0x8a4a36),
            Material::new(Pattern::Plaster, plaster, 0xffffff),
            Material::new(Pattern::Wallpaper, paper, ink),
            Material::new(Pattern::Plaster, plaster, 0xffffff).seeded(3),
            Material::new(Pattern::Planks, 0x8a5a34, 0xc6925a),
            Material::new(Pattern::Plaster, 0xf1efe9, 0xffffff).seeded(4),
            Material::new(Pattern::Window, 0xffffff, 0xffffff),
        ]);
        let materials = [0, 1, 2, 3, 4, 5].map(|face| first + face);
        let center = Vec3::new(0.0, 0.0, ROOM_HALF.z);
        self.objects.push(Object { shape: Shape::Room { half: ROOM_HALF }, center, yaw: Vec2::X, materials });

        let skirting = Material::new(Pattern::Plain, 0xeae6dc, 0xffffff);
        let (x, y) = (ROOM_HALF.x, ROOM_HALF.y);
        for side in [-1.0, 1.0] {
            self.cuboid(Vec3::new(side * (x - 0.01), 0.0, 0.0), Vec3::new(0.02, 2.0 * y, 0.1), 0.0, skirting);
            self.cuboid(Vec3::new(0.0, side * (y - 0.01), 0.0), Vec3::new(2.0 * x, 0.02, 0.1), 0.0, skirting);
        }
        // The ceiling lamp: a dark rim around a glowing disc.
        self.frustum(Vec3::new(0.0, 0.0, 2.72), 0.34, 0.34, 0.08, Material::new(Pattern::Plain, 0x55504a, 0));
        let glow = Material { color: Vec3::new(5.0, 4.5, 3.8), ..Material::new(Pattern::Lamp, 0, 0) };
        self.frustum(Vec3::new(0.0, 0.0, 2.70), 0.30, 0.30, 0.02, glow);
    }

    fn window_wall(&mut self) {
        let frame = Material::new(Pattern::Plain, 0xf3f0e8, 0xffffff);
        let (low, high) = WINDOW;
        let (left, right) = (low.x - ROOM_HALF.x, high.x - ROOM_HALF.x);
        let (middle, y) = (0.5 * (left + right), ROOM_HALF.y - 0.03);
        let width = right - left;
        for x in [left, middle, right] {
            self.cuboid(Vec3::new(x, y, low.y), Vec3::new(0.07, 0.06, high.y - low.y), 0.0, frame);
        }
        for z in [low.y - 0.035, 0.62 * high.y + 0.38 * low.y, high.y - 0.035] {
            self.cuboid(Vec3::new(middle, y, z), Vec3::new(width + 0.07, 0.06, 0.07), 0.0, frame);
        }
        self.cuboid(Vec3::new(middle, y - 0.06, low.y - 0.09), Vec3::new(width + 0.3, 0.18, 0.05), 0.0, frame);
        // Curtains: folds are cylinders side by side.
        let curtain = Material::new(Pattern::Stripes(7.0), 0xb5523b, 0xd9a066);
        for fold in 0..5 {
            for (x, side) in [(left - 0.06, -1.0), (right + 0.06, 1.0)] {
                let radius = 0.05 + 0.012 * (fold % 2) as f32;
                let base = Vec3::new(x + side * 0.085 * fold as f32, ROOM_HALF.y - 0.09, 0.12);
                self.frustum(base, radius * 1.15, radius * 0.8, 2.3, curtain);
            }
        }
        let rod = Material::new(Pattern::Plain, 0x4a3a2a, 0);
        self.cuboid(Vec3::new(middle, ROOM_HALF.y - 0.09, 2.42), Vec3::new(width + 1.2, 0.03, 0.03), 0.0, rod);
    }

    fn rug_and_table(&mut self, [.., rug, rug_accent]: [u32; 6]) {
        let rug = Material::new(Pattern::Rug, rug, rug_accent);
        self.cuboid(Vec3::ZERO, Vec3::new(2.9, 2.0, 0.012), 6.0, rug);

        let turn = self.rng.range(8.0, 24.0);
        let wood = Material::new(Pattern::Wood, 0x9a6a3c, 0x5d3a1c);
        let placed = |x: f32, y: f32, z: f32| Vec2::from_angle(turn.to_radians()).rotate(Vec2::new(x, y)).extend(z);
        let top = 0.56;
        self.cuboid(placed(0.0, 0.0, top - 0.05), Vec3::new(1.3, 0.8, 0.05), turn, wood.glossy(0.015));
        for (x, y) in [(-0.57, -0.32), (0.57, -0.32), (-0.57, 0.32), (0.57, 0.32)] {
            self.cuboid(placed(x, y, 0.012), Vec3::new(0.07, 0.07, top - 0.062), turn, wood);
        }
        // On the table.
        self.sphere(placed(-0.38, 0.1, top + 0.15), 0.15, 20.0, Material::new(Pattern::Marble, 0xe9e6df, 0x3b4a52));
        let glazed = Material::new(Pattern::Plain, 0xb01f24, 0).glossy(0.9);
        self.sphere(placed(-0.1, -0.2, top + 0.11), 0.11, 0.0, glazed);
        let pot = Material::new(Pattern::Stripes(14.0), 0x2f6f8f, 0xe8e2d2).glossy(0.15);
        self.frustum(placed(0.12, 0.17, top), 0.06, 0.11, 0.12, pot);
        self.frustum(placed(0.12, 0.17, top + 0.12), 0.11, 0.05, 0.14, pot);
        let leaves = Material::new(Pattern::Leaves, 0x3f7d3a, 0xa9c95a);
        for (x, y, z, r) in
            [(0.0, 0.0, 0.35, 0.1), (0.08, 0.03, 0.42, 0.075), (-0.07, 0.04, 0.43, 0.08), (0.0, -0.06, 0.48, 0.07)]
        {
            self.sphere(placed(0.12 + x, 0.17 + y, top + z), r, 40.0 * x, leaves);
        }
        let covers = [(0x2b4c7e, 0.0), (0xc9a227, 9.0), (0x7d2e46, -6.0)];
        for (i, (color, yaw)) in covers.into_iter().enumerate() {
            let base = placed(0.43, -0.12, top + 0.045 * i as f32);
            let size = Vec3::new(0.3 - 0.02 * i as f32, 0.21, 0.045);
            self.cuboid(base, size, turn + 70.0 + yaw, Material::new(Pattern::Book, color, 0xeadfc0));
        }
        let cube = Material::new(Pattern::Checker(18.0), 0xf2ead8, 0x222a33);
        self.cuboid(placed(0.42, -0.1, top + 0.135), Vec3::splat(0.11), turn + 30.0, cube);
    }

    fn sofa(&mut self) {
        let y = -2.5 + 0.45;
        let cloth = Material::new(Pattern::Fabric, 0x5c7f86, 0);
        self.cuboid(Vec3::new(0.2, y, 0.06), Vec3::new(2.1, 0.82, 0.26), 0.0, cloth);
        self.cuboid(Vec3::new(0.2, y - 0.31, 0.32), Vec3::new(2.1, 0.2, 0.5), 0.0, cloth);
        for side in [-1.0, 1.0] {
            self.cuboid(Vec3::new(0.2 + side * 1.08, y, 0.06), Vec3::new(0.18, 0.84, 0.54), 0.0, cloth);
            self.cuboid(Vec3::new(0.2 + side * 0.485, y + 0.08, 0.32), Vec3::new(0.94, 0.64, 0.13), 0.0, cloth);
        }
        let pillows = [
            (-0.55, Pattern::Chevron, 0xe3b23c, 0xf3ead3, 14.0),
            (0.35, Pattern::Dots, 0xc8553d, 0xf5e6c8, -10.0),
            (0.9, Pattern::Stripes(22.0), 0x2d3e50, 0xe9e3d5, -20.0),
        ];
        for (x, pattern, color, accent, yaw) in pillows {
            self.cuboid(
                Vec3::new(x, y - 0.12, 0.45),
                Vec3::new(0.42, 0.14, 0.38),
                yaw,
                Material::new(pattern, color, accent),
            );
        }
    }

    fn bookshelf(&mut self) {
        let wood = Material::new(Pattern::Wood, 0x6b4526, 0x3d2412);
        let (x, y, depth, width, height) = (-2.83, 0.2, 0.3, 1.5, 1.95);
        for side in [-1.0, 1.0] {
            self.cuboid(Vec3::new(x, y + side * 0.5 * (width - 0.03), 0.0), Vec3::new(depth, 0.03, height), 0.0, wood);
        }
        for shelf in 0..6 {
            let z = 0.04 + 0.376 * shelf as f32;
            self.cuboid(Vec3::new(x, y, z), Vec3::new(depth, width - 0.06, 0.03), 0.0, wood);
            if shelf < 5 {
                self.row_of_books(Vec3::new(x, y, z + 0.03), 0.5 * width - 0.05);
            }
        }
    }

    /// Upright books along y, as many as fit between `-half_width` and `half_width` of `middle`.
    fn row_of_books(&mut self, middle: Vec3, half_width: f32) {
        const COVERS: [u32; 10] =
            [0x8c2f39, 0x1f4e5f, 0xd9a441, 0x3a5a40, 0x5b3758, 0xc8643c, 0x27374d, 0xe0d6c2, 0x6b705c, 0x2a6f97];
        let mut at = -half_width;
        loop {
            let (thickness, tall) = (self.rng.range(0.03, 0.075), self.rng.range(0.2, 0.32));
            if self.rng.uniform() < 0.07 {
                at += self.rng.range(0.06, 0.2);
            }
            if at + thickness > half_width {
                return;
            }
            let book = Material::new(Pattern::Book, COVERS[self.rng.below(COVERS.len())], 0xe6cf8e);
            let base = middle + Vec3::new(self.rng.range(-0.02, 0.01), at + 0.5 * thickness, 0.0);
            self.cuboid(base, Vec3::new(0.22, thickness - 0.003, tall), 0.0, book);
            at += thickness;
        }
    }

    fn sideboard(&mut self) {
        let (x, y) = (-2.25, 2.5 - 0.24);
        let wood = Material::new(Pattern::Wood, 0xb98a56, 0x7d5228);
        self.cuboid(Vec3::new(x, y, 0.12), Vec3::new(1.1, 0.42, 0.62), 0.0, wood);
        for side in [-1.0, 1.0] {
            let door = Material::new(Pattern::Wood, 0xd8c19a, 0xa98558);
            self.cuboid(Vec3::new(x + side * 0.265, y - 0.215, 0.16), Vec3::new(0.5, 0.02, 0.54), 0.0, door);
            self.sphere(
                Vec3::new(x + side * 0.05, y - 0.24, 0.44),
                0.018,
                0.0,
                Material::new(Pattern::Plain, 0x2a2520, 0),
            );
        }
        let globe = Material::new(Pattern::Globe, 0x2f6ea3, 0x5c8f4a);
        self.frustum(Vec3::new(x + 0.28, y, 0.74), 0.09, 0.03, 0.06, Material::new(Pattern::Plain, 0x3a2a1c, 0));
        self.sphere(Vec3::new(x + 0.28, y, 0.97), 0.18, 35.0, globe);
        let vase = Material::new(Pattern::Marble, 0x2f7f79, 0xd8efe6);
        self.frustum(Vec3::new(x - 0.2, y, 0.74), 0.05, 0.1, 0.16, vase);
        self.frustum(Vec3::new(x - 0.2, y, 0.90), 0.1, 0.035, 0.16, vase);
    }

    fn armchair(&mut self) {
        let cloth = Material::new(Pattern::Chevron, 0xb9823f, 0x8f5f2a);
        let (x, y) = (2.5, -0.35);
        self.cuboid(Vec3::new(x, y, 0.1), Vec3::new(0.8, 0.8, 0.3), 0.0, cloth);
        self.cuboid(Vec3::new(x + 0.33, y, 0.4), Vec3::new(0.16, 0.8, 0.48), 0.0, cloth);
        for side in [-1.0, 1.0] {
            self.cuboid(Vec3::new(x - 0.02, y + side * 0.36, 0.4), Vec3::new(0.78, 0.12, 0.2), 0.0, cloth);
        }
        let pillow = Material::new(Pattern::Dots, 0x3b6e6e, 0xf0e6cf);
        self.cuboid(Vec3::new(x + 0.14, y, 0.4), Vec3::new(0.15, 0.38, 0.36), 8.0, pillow);
    }

    fn pictures(&mut self) {
        // Axis the wall is across, side, position along the wall, height of the centre, size, number.
        let hung = [
            (1, -1.0, -0.55, 1.65, Vec2::new(1.0, 0.68), 0),
            (1, -1.0, 0.62, 1.72, Vec2::new(0.62, 0.82), 1),
            (1, -1.0, 1.55, 1.6, Vec2::new(0.55, 0.55), 4),
            (0, 1.0, -0.4, 1.65, Vec2::new(1.25, 0.85), 2),
            (0, 1.0, 1.05, 1.6, Vec2::new(0.7, 0.9), 3),
            (0, -1.0, -1.35, 1.55, Vec2::new(0.7, 0.52), 3),
            (1, 1.0, -2.3, 1.75, Vec2::new(0.6, 0.6), 2),
        ];
        for (axis, side, along, z, size, number) in hung {
            let place = |inset: f32, height: f32| {
                let wall = side * (if axis == 0 { ROOM_HALF.x } else { ROOM_HALF.y } - inset);
                let p = if axis == 0 { Vec2::new(wall, along) } else { Vec2::new(along, wall) };
                p.extend(z - 0.5 * height)
            };
            let extent = |size: Vec2, depth: f32| match axis {
                0 => Vec3::new(depth, size.x, size.y),
                _ => Vec3::new(size.x, depth, size.y),
            };
            let frame = Material::new(Pattern::Wood, if number % 2 == 0 { 0x3a2717 } else { 0xb08a3e }, 0x241509);
            let outer = size + 0.1;
            self.cuboid(place(0.015, outer.y), extent(outer, 0.03), 0.0, frame);
            let canvas = Material::new(Pattern::Painting(number), 0, 0);
            self.cuboid(place(0.02, size.y), extent(size, 0.034), 0.0, canvas);
        }
    }

    fn plant(&mut self, base: Vec3) {
        let clay = Material::new(Pattern::Plaster, 0xb5653f, 0);
        self.frustum(base, 0.16, 0.23, 0.36, clay);
        self.frustum(base + 0.36 * Vec3::Z, 0.25, 0.25, 0.05, clay);
        self.frustum(base + 0.4 * Vec3::Z, 0.025, 0.018, 0.55, Material::new(Pattern::Wood, 0x6a4a2c, 0x3a2614));
        let leaves = Material::new(Pattern::Leaves, 0x2f6b35, 0x8fbf4d);
        for leaf in 0..14 {
            let (sin, cos) = (2.4 * leaf as f32).sin_cos();
            let spread = self.rng.range(0.05, 0.22);
            let z = 0.72 + 0.055 * leaf as f32;
            let radius = self.rng.range(0.09, 0.15);
            self.sphere(base + Vec3::new(spread * cos, spread * sin, z), radius, 50.0 * leaf as f32, leaves);
        }
    }

    fn floor_lamp(&mut self, base: Vec3) {
        let metal = Material::new(Pattern::Plain, 0x3c3a38, 0);
        self.frustum(base, 0.17, 0.15, 0.03, metal);
        self.frustum(base + 0.03 * Vec3::Z, 0.015, 0.015, 1.42, metal);
        let shade = Material { color: Vec3::new(1.9, 1.35, 0.75), ..Material::new(Pattern::Lamp, 0, 0) };
        self.frustum(base + 1.45 * Vec3::Z, 0.23, 0.15, 0.32, shade);
    }

    fn things_on_the_floor(&mut self) {
        let shift = |rng: &mut Rng| Vec3::new(rng.range(-0.08, 0.08), rng.range(-0.08, 0.08), 0.0);
        let ball = Vec3::new(1.15, 0.95, 0.22) + shift(&mut self.rng);
        self.sphere(ball, 0.22, 25.0, Material::new(Pattern::Ball, 0xd0402f, 0x2f6fb0));
        let pouf = Vec3::new(-1.25, -0.75, 0.012) + shift(&mut self.rng);
        self.frustum(pouf, 0.27, 0.3, 0.34, Material::new(Pattern::Stripes(9.0), 0xd8c7a3, 0x3f6d6a));
        let crate_place = Vec3::new(-1.2, 1.15, 0.0) + shift(&mut self.rng);
        let crate_turn = self.rng.range(15.0, 50.0);
        self.cuboid(crate_place, Vec3::splat(0.42), crate_turn, Material::new(Pattern::Crate, 0xc49a63, 0x9a6f3c));
        self.sphere(
            crate_place + Vec3::new(0.0, 0.0, 0.54),
            0.12,
            70.0,
            Material::new(Pattern::Stripes(12.0), 0xe8b93a, 0x2d3e50),
        );
        let blocks = [(0x2f6fb0, 0xf0e8d8, 0.0), (0xd0402f, 0xf0e8d8, 0.14), (0x4f9a4b, 0xf0e8d8, 0.28)];
        let tower = Vec3::new(0.75, -1.2, 0.0) + shift(&mut self.rng);
        for (color, accent, z) in blocks {
            let turn = self.rng.range(0.0, 90.0);
            self.cuboid(
                tower + z * Vec3::Z,
                Vec3::splat(0.14),
                turn,
                Material::new(Pattern::Checker(28.5), color, accent),
            );
        }
    }
}

/// Colour of the highlights on glossy things: daylight.
pub(super) fn highlight_color() -> Vec3 {
    hex(0xf4f8ff)
}
