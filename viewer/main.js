import { Scene } from "three"; new Scene();
